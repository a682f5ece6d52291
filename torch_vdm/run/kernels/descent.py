"""A step down the quad-tree by a kernel of Triton, and its gradient by another."""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.grid import Before
from torch_vdm.run import kernels
from torch_vdm.run.gradients.descent import gradients_of_passed_down, passed_down_by


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
    sizes = *nodes.shape[-2:], *parents.shape[-2:], *before
    kernels.launch(kernel, written[0].numel(), len(nodes), planes, sizes)


passed_down_by_kernel = passed_down_by(_PassedDown)
