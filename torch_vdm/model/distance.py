"""Distance summation, the last box of Fig. 2: Quick's vector sum over channels and levels."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.charging import Charge
from torch_vdm.model.grid import NONE, Before
from torch_vdm.model.quadtree import push

# A difference above this, in JND, is visible: the unit's definition.
VISIBLE = 1.0

# Differences are clamped to this, in JND, so that their 6th power stays finite in float32. Light
# has no such differences, but values below 0 may. Status: choice.
LARGEST_DIFFERENCE = 1e5

# Below this the power of a difference is 0 in float32. Status: choice.
SMALLEST_DIFFERENCE = 1e-30


def local_visual_difference(difference: Tensor, exponent: Tensor) -> Tensor:
    """Return the local visual difference of every node (Eq. 5).

    The sum over channels and orientations of abs(P1 - P2)^2.4. Eq. 5 prints no absolute value;
    a negative base needs one.

    Parameters
    ----------
    difference
        (B, channels, orientations, h, w): that of the two images' pooled responses.
    exponent
        2.4 in the paper.

    Returns
    -------
    Tensor
        (B, 1, h, w), in JND to the power of ``exponent``.
    """
    size = difference.abs()
    # size^exponent as a square times the remaining power, in the processor's native base 2: faster
    # than a power, exactly 0 at 0, and with finite derivatives there.
    rest = torch.exp2((exponent - 2.0) * torch.log2(size.clamp_min(SMALLEST_DIFFERENCE)))
    return (size * size * rest).sum((1, 2)).unsqueeze(1)


def local_visual_difference_of_energy(
    energy: Tensor, exponent: Tensor, left: Tensor | float = 0.0
) -> Tensor:
    """Return the local visual difference of squared differences: their power of exponent / 2.

    Arguments are as in `local_visual_difference`, but the squared difference is the ``energy``
    times 2^``left``.
    """
    octaves = torch.log2(energy.clamp_min(SMALLEST_DIFFERENCE))
    held = (octaves + left).clamp_max(2.0 * math.log2(LARGEST_DIFFERENCE))
    # The energy times its remaining power: exactly 0 at 0.
    power = energy * torch.exp2(0.5 * exponent * held - octaves)
    return power.sum((1, 2)).unsqueeze(1)


def cubes(ratio: Tensor, factor: Tensor | float) -> Tensor:
    """Return the same for an exponent of 6, of squared differences ``ratio`` times ``factor``.

    The power is then two multiplications.
    """
    squared = (ratio * factor).clamp_max(LARGEST_DIFFERENCE**2)
    return (squared * squared * squared).sum((1, 2)).unsqueeze(1)


class Paths(NamedTuple):
    """What accumulates down the paths of the quad-tree."""

    local: tuple[Tensor, ...]
    """One (B, 1, h, w) per level, level 0 (the root) first: what `accumulate` takes."""
    changes: tuple[Tensor, ...]
    """The same shapes: how far the means of nodes differ, see `charging.changes`; or empty."""
    root: Tensor
    """(B, 1, 1, 1), the value that every path starts from."""


def passed_down(nodes: Tensor, total: Tensor, charge: Charge | None, before: Before) -> Tensor:
    """Return what has accumulated at the nodes of a level, (B, 1, h, w): a step of `accumulate`.

    ``nodes`` are their local differences; ``total`` is what has accumulated at their parents.
    """
    parents = push(total, (nodes.shape[-2], nodes.shape[-1]), before)
    if charge is None:
        return nodes + parents
    own = nodes if charge.own is None else nodes * charge.own
    return torch.addcmul(own, parents, charge.inherited)


# `passed_down`, or what gives the same.
Step = Callable[[Tensor, Tensor, Charge | None, Before], Tensor]


def accumulate(
    local: Sequence[Tensor],
    root: Tensor,
    before: Sequence[Before] = (),
    charges: Sequence[Charge] | None = None,
    down: Step = passed_down,
) -> Tensor:
    """Sum the local differences down every path of the quad-tree.

    Parameters
    ----------
    local
        One (B, 1, h, w) per level, level 0 (the root) first; none for an image of one pixel.
    root
        (B, 1, 1, 1), the value that every path starts from: the lowpass term, or 0.
    before
        For each level, how many nodes are put before its first; none by default.
    charges
        One per level: what its nodes are charged. None: all that their parent has, as printed.
    down
        What computes `passed_down`.

    Returns
    -------
    Tensor
        (B, 1, h, w) of the finest level, in JND to the power of the summation exponent.
    """
    total = root
    for level, (nodes, first) in enumerate(zip(local, before or [NONE] * len(local), strict=True)):
        total = down(nodes, total, None if charges is None else charges[level], first)
    return total


def just_noticeable(total: Tensor, exponent: Tensor | float) -> Tensor:
    """Return the root of accumulated differences, in JND.

    Its infinite slope at 0 is replaced by 0. The slope of the power is 0 there as well, so the
    derivative with respect to an image is finite everywhere.
    """
    differs = total > 0.0
    return torch.where(differs, torch.where(differs, total, 1.0) ** (1.0 / exponent), 0.0)
