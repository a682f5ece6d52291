"""A 3x3 matrix applied to the channel axis: Eq. 1, Eq. 3 and the display's primaries."""

from collections.abc import Sequence

import torch
from torch import Tensor


def mix(matrix: Tensor, planes: Tensor) -> Tensor:
    """Return the channels of ``planes`` mixed by ``matrix``.

    It is written as multiplications and additions: a matrix product would run in bfloat16 under
    autocast and in TF32 where a user allows it, and its last bits may depend on alignment, so
    that two equal images would differ.

    Parameters
    ----------
    matrix
        (N, C), one row per output channel.
    planes
        (B, C, ...), C of 1 or more.

    Returns
    -------
    Tensor
        (B, N, ...).
    """
    channels = planes.unbind(1)
    return torch.stack([mix_row(row, channels) for row in matrix], 1)


def mix_row(row: Tensor, channels: Sequence[Tensor]) -> Tensor:
    """Return one output channel (B, ...) of `mix`, from the input channels one by one."""
    first, *others = channels
    mixed = first * row[0]
    for number, plane in enumerate(others, 1):
        mixed = torch.addcmul(mixed, plane, row[number])
    return mixed


def product(first: Tensor, second: Tensor) -> Tensor:
    """Return the matrix that mixes by ``second``, then by ``first``; (3, 3) each.

    It does without ``@``, for the reasons given in `mix`.
    """
    return (first.unsqueeze(-1) * second).sum(1)
