"""Gradients that are worked out by hand, which keep and compute less than autograd's."""

import torch
from torch.autograd import forward_ad


def by_hand() -> bool:
    """Return whether these gradients can be used, and are of use."""
    return torch.is_grad_enabled() and is_plain()


def is_plain() -> bool:
    """Return whether nothing traces or transforms the computation."""
    return (
        not torch.compiler.is_compiling()
        and not torch._C._are_functorch_transforms_active()
        and forward_ad._current_level < 0
    )
