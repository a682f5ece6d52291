"""Samples of two planes in turn, in one: what every enlargement ends with."""

import torch
from torch import Tensor


def interleaved(even: Tensor, odd: Tensor, dim: int) -> Tensor:
    """Return (..., 2 h, w) or (..., h, 2 w) with the samples of two planes (..., h, w) in turn.

    Along ``dim``, -2 or -1; the first sample is that of ``even``.
    """
    if dim == -1 and not torch.compiler.is_compiling() and even.is_floating_point():
        # A stack whose last side is 2 is copied number by number, five times as slowly as a plane
        # of complex numbers is written, which lie the same way.
        return torch.view_as_real(torch.complex(even, odd)).flatten(-2)
    return torch.stack((even, odd), dim).flatten(dim - 1, dim)
