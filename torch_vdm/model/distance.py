"""Distance summation, the last box of Fig. 2: Quick's vector sum over channels and levels."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.charging import Charge
from torch_vdm.model.grid import NONE, Before
from torch_vdm.model.quadtree import push

# A difference over this is visible, in JND: the unit's definition.
VISIBLE = 1.0

# A difference counts for no more, in JND, so that its power of 6 stays finite in float32. Light has
# no such differences; values below 0 may. Status: choice.
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
        (B, channels, orientations, h, w): what is left of the two images' pooled responses.
    exponent
        2.4 in the paper.

    Returns
    -------
    Tensor
        (B, 1, h, w), in JND to the power of ``exponent``.
    """
    size = difference.abs()
    # size^exponent, as a square times what is left, in the processor's own base 2: faster than a
    # power, exactly 0 at 0, and with finite derivatives there.
    rest = torch.exp2((exponent - 2.0) * torch.log2(size.clamp_min(SMALLEST_DIFFERENCE)))
    return (size * size * rest).sum((1, 2)).unsqueeze(1)


def local_visual_difference_of_energy(
    energy: Tensor, exponent: Tensor, left: Tensor | float = 0.0
) -> Tensor:
    """Return the local visual difference of squared differences: their power of exponent / 2.

    Arguments as `local_visual_difference`, whose square is the ``energy`` times 2^``left``.
    """
    octaves = torch.log2(energy.clamp_min(SMALLEST_DIFFERENCE))
    held = (octaves + left).clamp_max(2.0 * math.log2(LARGEST_DIFFERENCE))
    # The energy times what is left of its power: exactly 0 at 0.
    power = energy * torch.exp2(0.5 * exponent * held - octaves)
    return power.sum((1, 2)).unsqueeze(1)


def cubes(ratio: Tensor, factor: Tensor | float) -> Tensor:
    """Return the same for an exponent of 6, of squared differences ``ratio`` times ``factor``.

    Two multiplications are their power.
    """
    squared = (ratio * factor).clamp_max(LARGEST_DIFFERENCE**2)
    return (squared * squared * squared).sum((1, 2)).unsqueeze(1)


class Paths(NamedTuple):
    """What accumulates down the paths of the quad-tree."""

    local: tuple[Tensor, ...]
    """One (B, 1, h, w) a level, level 0 (the root) first: what `accumulate` takes."""
    changes: tuple[Tensor, ...]
    """The same shapes: how far the means of nodes differ, `charging.changes`; or none."""
    root: Tensor
    """(B, 1, 1, 1), what every path begins with."""


def accumulate(
    local: Sequence[Tensor],
    root: Tensor,
    items: int = 1,
    before: Sequence[Before] = (),
    charges: Sequence[Charge] | None = None,
) -> Tensor:
    """Sum the local differences down every path of the quad-tree.

    Parameters
    ----------
    local
        One (B, 1, h, w) a level, level 0 (the root) first; none for an image of one pixel.
    root
        (B, 1, 1, 1), what every path begins with: the lowpass term, or 0.
    items
        How many trees lie below one another, root (1, 1, items, 1) and all.
    before
        For each level what is put before its first node; nothing by default.
    charges
        One a level: what a node is charged. None: every child all that its parent has, as printed.

    Returns
    -------
    Tensor
        (B, 1, h, w) of the finest level, in JND to the power of the summation.
    """
    total = root
    for level, (nodes, first) in enumerate(zip(local, before or [NONE] * len(local), strict=True)):
        total = push(total, (nodes.shape[-2], nodes.shape[-1]), items, first)
        if charges is None:
            total = nodes + total
            continue
        inherited, own = charges[level]
        total = torch.addcmul(nodes if own is None else nodes * own, total, inherited)
    return total


def just_noticeable(total: Tensor, exponent: Tensor) -> Tensor:
    """Return the root of accumulated differences, in JND.

    Its slope at 0, which is infinite, is given as 0: together with the power's own slope, which
    is 0 there, the derivative by an image is finite everywhere.
    """
    differs = total > 0.0
    return torch.where(differs, torch.where(differs, total, 1.0) ** (1.0 / exponent), 0.0)
