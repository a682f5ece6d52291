"""A step down the quad-tree by a kernel of Triton, and its gradient by another."""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.charging import Charge
from torch_vdm.model.distance import passed_down
from torch_vdm.model.grid import Before
from torch_vdm.run import kernels
from torch_vdm.run.gradients.descent import gradients_of_passed_down


def passed_down_by_kernel(
    nodes: Tensor, total: Tensor, charge: Charge | None, before: Before
) -> Tensor:
    """Return `passed_down`; the kernel is for nodes that are charged all of their own."""
    if charge is None or charge.own is not None:
        return passed_down(nodes, total, charge, before)
    passed: Tensor = _PassedDown.apply(nodes, total, charge.inherited, before)
    return passed


class _PassedDown(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, nodes: Tensor, total: Tensor, inherited: Tensor, before: Before
    ) -> Tensor:
        total, inherited = total.contiguous(), inherited.contiguous()
        ctx.save_for_backward(total, inherited)
        ctx.before = before
        passed = torch.empty_like(inherited)
        _launch("descent", (nodes.contiguous(), total, inherited, passed), before)
        return passed

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        total, inherited = ctx.saved_tensors
        if torch.is_grad_enabled():
            return gradients_of_passed_down(gradient, total, inherited, ctx.before)
        by_total, by_inherited = torch.empty_like(total), torch.empty_like(inherited)
        planes = gradient.contiguous(), total, inherited, by_total, by_inherited
        _launch("ascent", planes, ctx.before)
        return gradient, by_total, by_inherited, None


def _launch(name: str, planes: tuple[Tensor, ...], before: Before) -> None:
    """Launch a kernel with a program for each block of nodes, or of parents, of each item."""
    nodes, parents = planes[0], planes[1]
    kernel = getattr(kernels.of("triton_descent", nodes.device), name)
    written = nodes if name == "descent" else parents
    grid = -(-written[0].numel() // kernels.BLOCK), len(nodes)
    sizes = *nodes.shape[-2:], *parents.shape[-2:], *before
    with torch.cuda.device_of(nodes):
        kernel[grid](*planes, *sizes, block=kernels.BLOCK, enable_fp_fusion=False)
