"""Steps of `Haar` by kernels of Triton: one launch each, and one for its gradient."""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.cortex.border import Across, Down, with_siblings
from torch_vdm.model.grid import NONE, Before, Side
from torch_vdm.run import kernels
from torch_vdm.run.gradients.analysis import synthesised, synthesised_at_border


def analysed(even: Tensor) -> tuple[Tensor, Tensor]:
    """Return `analyse`."""
    found: tuple[Tensor, Tensor] = _Analysis.apply(even)
    return found


def analysed_at_border(
    children: Tensor, sides: tuple[Side, Side], down: Down, across: Across
) -> tuple[Tensor, Tensor, Tensor]:
    """Return `analyse_at_border` of planes `with_siblings`."""
    weights = down.weights, down.half, across.weights
    found: tuple[Tensor, Tensor, Tensor] = _AnalysisAtBorder.apply(children, sides, *weights)
    return found


class _Analysis(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, even: Tensor) -> tuple[Tensor, Tensor]:
        del ctx
        lowpass, details = _planes_for(even, NONE)
        _launch("analysis", even.contiguous(), NONE, lowpass, details)
        return lowpass, details

    @staticmethod
    def backward(ctx: Any, lowpass: Tensor, details: Tensor) -> Tensor:
        del ctx
        if torch.is_grad_enabled():
            return synthesised(lowpass, details)
        *planes, height, width = lowpass.shape
        even = lowpass.new_empty(*planes, 2 * height, 2 * width)
        _launch("synthesis", even, NONE, lowpass, details)
        return even


class _AnalysisAtBorder(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, children: Tensor, sides: tuple[Side, Side], *weights: Tensor
    ) -> tuple[Tensor, ...]:
        ctx.save_for_backward(*weights)
        ctx.shape, ctx.sides = children.shape, sides
        before = _before(sides)
        lowpass, details = _planes_for(children, before)
        window = torch.empty_like(lowpass)
        _launch("analysis", children.contiguous(), before, lowpass, details, window, *weights)
        return lowpass, details, window

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        weights: tuple[Tensor, ...] = ctx.saved_tensors
        if torch.is_grad_enabled():
            even = synthesised_at_border(*gradients, *weights)
            return _without_siblings(even, ctx.shape, ctx.sides), None, None, None, None
        children = gradients[0].new_empty(ctx.shape)
        _launch("synthesis", children, _before(ctx.sides), *gradients, *weights)
        return children, None, None, None, None


def _without_siblings(even: Tensor, shape: tuple[int, ...], sides: tuple[Side, Side]) -> Tensor:
    """Return the gradient of `with_siblings` of planes of a shape, from that by what it returns."""
    children = even.new_zeros(shape).requires_grad_()
    found: Tensor
    (found,) = torch.autograd.grad(
        with_siblings(children, sides), children, even, create_graph=True
    )
    return found


def _before(sides: tuple[Side, Side]) -> Before:
    return sides[0].before, sides[1].before


def _planes_for(children: Tensor, before: Before) -> tuple[Tensor, Tensor]:
    """Return planes for the lowpass and the details of planes (B, C, rows, columns)."""
    *planes, rows, columns = children.shape
    size = (rows + before[0] + 1) // 2, (columns + before[1] + 1) // 2
    return children.new_empty(*planes, *size), children.new_empty(*planes, 3, *size)


def _launch(
    name: str, children: Tensor, before: Before, lowpass: Tensor, details: Tensor, *others: Tensor
) -> None:
    """Launch a kernel, of which a program writes a block of nodes or of children of a plane."""
    kernel = getattr(kernels.of("triton_haar", children), name)
    planes = [lowpass, details, *others]
    border = bool(others)
    sizes = [*children.shape[-2:], *before, *lowpass.shape[-2:]]
    written = lowpass
    if name == "synthesis":
        written = children
        # Of the lowpass, the details and the window.
        for number in range(3 if border else 2):
            planes[number], stride = _beside(planes[number])
            sizes.append(stride)
        sizes += [0] * (9 - len(sizes))  # not used
    planes += [children] * (6 - len(planes))  # not used
    nodes, items = written.shape[-2] * written.shape[-1], written[..., 0, 0].numel()
    kernels.launch(
        kernel,
        kernels.programs(nodes, kernels.BLOCK),
        items,
        (children, *planes),
        sizes,
        border=border,
    )


def _beside(planes: Tensor) -> tuple[Tensor, int]:
    """Return planes (..., h, w) of whole rows, and how far one begins after another."""
    # Gradients by several levels are parts of one column, and are not copied.
    flat = planes.flatten(-2).flatten(0, -2)
    if flat.stride(1) != 1 and flat.shape[1] > 1:
        flat = flat.contiguous()
    return flat, flat.stride(0)
