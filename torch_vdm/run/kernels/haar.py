"""Steps of `Haar` by kernels of Triton: one launch each, and one for its gradient."""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.cortex.border import Across, Down
from torch_vdm.run import kernels
from torch_vdm.run.gradients.analysis import synthesised, synthesised_at_border


def analysed(even: Tensor) -> tuple[Tensor, Tensor]:
    """Return `analyse`."""
    found: tuple[Tensor, Tensor] = _Analysis.apply(even)
    return found


def analysed_at_border(even: Tensor, down: Down, across: Across) -> tuple[Tensor, Tensor, Tensor]:
    """Return `analyse_at_border`."""
    weights = down.weights, down.half, across.weights
    found: tuple[Tensor, Tensor, Tensor] = _AnalysisAtBorder.apply(even, *weights)
    return found


class _Analysis(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, even: Tensor) -> tuple[Tensor, Tensor]:
        del ctx
        lowpass, details = _planes_for(even)
        _launch("analysis", even.contiguous(), lowpass, details)
        return lowpass, details

    @staticmethod
    def backward(ctx: Any, lowpass: Tensor, details: Tensor) -> Tensor:
        del ctx
        if torch.is_grad_enabled():
            return synthesised(lowpass, details)
        even = _even_for(lowpass)
        _launch("synthesis", even, lowpass.contiguous(), details.contiguous())
        return even


class _AnalysisAtBorder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, even: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(*weights)
        lowpass, details = _planes_for(even)
        window = torch.empty_like(lowpass)
        _launch("analysis", even.contiguous(), lowpass, details, window, *weights)
        return lowpass, details, window

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        weights: tuple[Tensor, ...] = ctx.saved_tensors
        if torch.is_grad_enabled():
            return synthesised_at_border(*gradients, *weights), None, None, None
        even = _even_for(gradients[0])
        _launch("synthesis", even, *(each.contiguous() for each in gradients), *weights)
        return even, None, None, None


def _planes_for(even: Tensor) -> tuple[Tensor, Tensor]:
    """Return planes for the lowpass and the details of a plane (B, C, 2 h, 2 w)."""
    *planes, height, width = even.shape
    size = height // 2, width // 2
    return even.new_empty(*planes, *size), even.new_empty(*planes, 3, *size)


def _even_for(lowpass: Tensor) -> Tensor:
    """Return a plane for the gradient by what has a lowpass (B, C, h, w)."""
    *planes, height, width = lowpass.shape
    return lowpass.new_empty(*planes, 2 * height, 2 * width)


def _launch(name: str, even: Tensor, lowpass: Tensor, *others: Tensor) -> None:
    """Launch a kernel with a program for each block of nodes of each plane."""
    kernel = getattr(kernels.of("triton_haar", even.device), name)
    planes = [even, lowpass, *others]
    border = len(planes) > 3
    planes += [even] * (7 - len(planes))  # not used
    height, width = lowpass.shape[-2:]
    items = lowpass[..., 0, 0].numel()
    kernels.launch(kernel, height * width, items, planes, (height, width), border=border)
