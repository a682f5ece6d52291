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
        (N, C), one row per output channel; or (N, C, ...) with one matrix for every place.
    planes
        (B, C, ...), C of 1 or more.

    Returns
    -------
    Tensor
        (B, N, ...).
    """
    # All rows at once, a channel at a time: nearly twice as fast as a row at a time.
    matrix = matrix.reshape(*matrix.shape, *[1] * (planes.ndim - matrix.ndim))
    columns = matrix.unbind(1)
    # `torch.vmap` has no rule for the one in place.
    transformed = torch._C._are_functorch_transforms_active()
    added = torch.addcmul if transformed else Tensor.addcmul_
    mixed = planes[:, :1] * columns[0]
    for number, column in enumerate(columns[1:], 1):
        mixed = added(mixed, planes[:, number : number + 1], column)
    return mixed


def mix_row(row: Tensor, channels: Sequence[Tensor]) -> Tensor:
    """Return one output channel (B, ...) of `mix`, where all of them at once take too much memory.

    ``channels`` are the input channels one by one.
    """
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
