"""The way down the quad-tree by one kernel of Triton, and its gradient by one for each level."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.charging import Charge
from torch_vdm.model.distance import Paths, accumulate
from torch_vdm.model.grid import Before
from torch_vdm.run import kernels
from torch_vdm.run.column import apart, joined
from torch_vdm.run.kernels.table import Table, table_of


def accumulated(paths: Paths, charge: Charge, before: Sequence[Before]) -> Tensor:
    """Return `accumulate` of differences, with the shares of all levels in a column."""
    sizes = tuple((plane.shape[-2], plane.shape[-1]) for plane in paths.local)
    table = table_of(sizes, (sizes[0], *sizes[:-1]), before, paths.root)

    def plain(local: Tensor, inherited: Tensor, root: Tensor) -> Tensor:
        shares = [Charge(share, None) for share in apart(inherited, sizes)]
        return accumulate(apart(local, sizes), root, before, shares)

    columns = joined(paths.local), charge.inherited.contiguous()
    found: Tensor = _Accumulated.apply(plain, table, *columns, paths.root)
    return found


class _Accumulated(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        plain: Callable[..., Tensor],
        table: Table,
        local: Tensor,
        inherited: Tensor,
        root: Tensor,
    ) -> Tensor:
        total = torch.empty_like(local)
        leaves = local.new_empty(*local.shape[:2], *table.sizes[-1])
        planes = local, inherited, root.contiguous(), table.rows, total, leaves
        sizes = len(table.sizes), table.nodes
        kernel = kernels.of("triton_descent", local).descent
        kernels.launch(kernel, table.programs, len(local), planes, sizes)
        ctx.plain, ctx.table = plain, table
        ctx.save_for_backward(local, inherited, root, total)
        return leaves

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        local, inherited, root, total = ctx.saved_tensors
        wanted: tuple[bool, ...] = ctx.needs_input_grad[2:]
        if torch.is_grad_enabled():
            planes = local, inherited, root
            return None, None, *kernels.differentiated(ctx.plain, planes, wanted, gradient)
        return None, None, *_gradients(gradient, local, inherited, root, total, ctx.table)


def _gradients(
    gradient: Tensor, local: Tensor, inherited: Tensor, root: Tensor, total: Tensor, table: Table
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients by local differences, shares and the root."""
    by_local, by_inherited = torch.empty_like(local), torch.empty_like(inherited)
    by_root = torch.empty_like(root, memory_format=torch.contiguous_format)
    apart(by_local, table.sizes)[-1].copy_(gradient)
    kernel = kernels.of("triton_descent", local).ascent
    planes = by_local, total, inherited, root.contiguous(), table.rows, by_inherited, by_root
    for number in reversed(range(len(table.sizes))):
        parents = math.prod(table.sizes[max(number - 1, 0)])
        count = kernels.programs(parents, kernels.BLOCK)
        kernels.launch(kernel, count, len(local), planes, (table.nodes, number))
    return by_local, by_inherited, by_root
