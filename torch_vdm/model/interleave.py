"""Two planes interleaved: the last step of every upsampling."""

import torch
from torch import Tensor


def interleaved(even: Tensor, odd: Tensor, dim: int) -> Tensor:
    """Return two planes (..., h, w) interleaved, (..., 2 h, w) or (..., h, 2 w).

    They alternate along ``dim``, -2 or -1, beginning with ``even``.
    """
    if dim == -1 and not torch.compiler.is_compiling() and even.is_floating_point():
        # A stack whose last dimension is 2 is copied element by element, five times as slowly as
        # a plane of complex numbers, which has the same memory layout, is written.
        return torch.view_as_real(torch.complex(even, odd)).flatten(-2)
    return torch.stack((even, odd), dim).flatten(dim - 1, dim)
