"""A 3x3 matrix applied to the channel axis: Eq. 1, Eq. 3 and the display's primaries."""

import torch
from torch import Tensor


def mix(matrix: Tensor, planes: Tensor) -> Tensor:
    """Return the channels of ``planes`` mixed by ``matrix``.

    Written as multiplications and additions: a matrix product would run in bfloat16 under
    autocast and in TF32 where a user allows it, and its last bits may depend on alignment, so
    that two equal images would differ.

    Parameters
    ----------
    matrix
        (N, C); N rows are N output channels.
    planes
        (B, C, ...), C of 1 or more.

    Returns
    -------
    Tensor
        (B, N, ...).
    """
    first, *others = planes.unbind(1)
    rows = []
    for row in matrix:
        mixed = first * row[0]
        for number, plane in enumerate(others, 1):
            mixed = torch.addcmul(mixed, plane, row[number])
        rows.append(mixed)
    return torch.stack(rows, 1)


def product(first: Tensor, second: Tensor) -> Tensor:
    """Return the matrix that mixes by ``second``, then by ``first``; (3, 3) each.

    Not by ``@``, for the reasons of `mix`.
    """
    return (first.unsqueeze(-1) * second).sum(1)
