"""Pixels replaced that are not finite, by a kernel of Triton."""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.images import SQUARE
from torch_vdm.run import kernels


def finite_in_both(test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return `torch_vdm.images.finite_in_both`."""
    found: tuple[Tensor, Tensor, Tensor] = _FiniteInBoth.apply(test, reference)
    return found


class _FiniteInBoth(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        items, _, height, width = test.shape
        kernel = kernels.of("triton_mask", test).finite_in_both
        seen = torch.empty(items, 1, height, width, dtype=torch.uint8, device=test.device)
        found = torch.empty_like(test), torch.empty_like(reference)
        squares = kernels.programs(height, SQUARE) * kernels.programs(width, SQUARE)
        planes = test, reference, *found, seen
        kernels.launch(kernel, squares, items, planes, (height, width), block=SQUARE)
        both = seen.view(torch.bool)
        needed = zip(found, ctx.needs_input_grad, strict=True)
        ctx.mark_non_differentiable(both, *(image for image, needs in needed if not needs))
        ctx.save_for_backward(both)
        return *found, both

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (seen,) = ctx.saved_tensors
        wanted = zip(gradients[:2], ctx.needs_input_grad, strict=True)
        return tuple(torch.where(seen, each, 0.0) if want else None for each, want in wanted)
