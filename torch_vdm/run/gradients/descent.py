"""The gradient of a step down the quad-tree, worked out by hand: sums over children."""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.charging import Charge
from torch_vdm.model.distance import Step, passed_down
from torch_vdm.model.grid import Before
from torch_vdm.model.quadtree import push


def passed_down_by(function: type[torch.autograd.Function]) -> Step:
    """Return `passed_down` by a function of nodes, total, share inherited and nodes before.

    It is for nodes that are charged all of their own; the model's own step does others.
    """

    def passed(nodes: Tensor, total: Tensor, charge: Charge | None, before: Before) -> Tensor:
        if charge is None or charge.own is not None:
            return passed_down(nodes, total, charge, before)
        found: Tensor = function.apply(nodes, total, charge.inherited, before)
        return found

    return passed


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
        return gradients_of_passed_down(gradient, total, inherited, ctx.before)


def gradients_of_passed_down(
    gradient: Tensor, total: Tensor, inherited: Tensor, before: Before
) -> tuple[Tensor, Tensor, Tensor, None]:
    """Return the gradients of `passed_down` by nodes, ``total`` and ``inherited``."""
    (height, width), (top, left) = gradient.shape[-2:], before
    sides = left, (width + left) % 2, top, (height + top) % 2
    charged = gradient * inherited
    # Never less than the parents need: the root is also its own parent.
    children = functional.pad(charged, sides) if any(sides) else charged
    by_total = functional.avg_pool2d(children, 2, divisor_override=1)
    return gradient, by_total, gradient * push(total, (height, width), before), None


passed_down_by_hand = passed_down_by(_PassedDown)
