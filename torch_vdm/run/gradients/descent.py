"""The gradient of a step down the quad-tree, worked out by hand: sums over children."""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.charging import Charge
from torch_vdm.model.distance import passed_down
from torch_vdm.model.grid import Before
from torch_vdm.model.quadtree import push


def passed_down_by_hand(
    nodes: Tensor, total: Tensor, charge: Charge | None, before: Before
) -> Tensor:
    """Return `passed_down`, with its gradient by hand.

    It is for nodes that are charged all of their own; the model's own step does others.
    """
    if charge is None or charge.own is not None:
        return passed_down(nodes, total, charge, before)
    found: Tensor = _PassedDown.apply(nodes, total, charge.inherited, before)
    return found


class _PassedDown(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, nodes: Tensor, total: Tensor, inherited: Tensor, before: Before
    ) -> Tensor:
        ctx.save_for_backward(total, inherited)
        ctx.before = before
        return passed_down(nodes, total, Charge(inherited, None), before)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        total, inherited = ctx.saved_tensors
        (height, width), (top, left) = gradient.shape[-2:], ctx.before
        sides = left, (width + left) % 2, top, (height + top) % 2
        charged = gradient * inherited
        # Never less than the parents need: the root is also its own parent.
        children = functional.pad(charged, sides) if any(sides) else charged
        by_total = functional.avg_pool2d(children, 2, divisor_override=1)
        return gradient, by_total, gradient * push(total, (height, width), ctx.before), None
