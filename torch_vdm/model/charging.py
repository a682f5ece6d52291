"""Which of its pixels a coarse difference is charged to.

A node of a coarse level spans many pixels, and as a rule few of them made the difference that it
has. Going down the quad-tree, every node takes from what its parent has accumulated the share that
its own mean differs by, beside the means around it: a coarse detail is made of nothing but these
means. Where two images are equal the share is exactly 0. Status of the whole file: choice, ours.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.quadtree import apart, together

# How many nodes to each side, in the width of one, count as those near by, and as those around:
# the second is as far as pooling and the lowpass of a parent spread the difference of a parent's
# neighbour, two of its nodes and so five. Status: derived, for `Haar`.
NEAR, AROUND = 1, 5

# The squared difference of a node's mean over that around it, at which half is left of the base of
# the inherited share, and the power of that base; a ratio of 1 or more takes all. Noise scatters
# from node to node, and gratings have zeros: they are to keep what they have, within 3 % of the
# largest value, and the surroundings of a lamp are to inherit nothing. Status: choice, measured.
SOFT, POWER = 0.005, 4

# Behind a filter a node differs where its own light does not, for the filter has spread what does.
# What it has of its own is charged to it where its light differs by this share of the mean around
# it, and else in proportion. Status: choice, measured.
FAINT = 0.1

# In a cache, planes with more numbers are summed up along one side and the other. Status:
# choice, measured.
SMALL = 2**10


class Charge(NamedTuple):
    """What a node is charged, (B, 1, h, w), 0 to 1; for differences to the power of 6."""

    inherited: Tensor
    """Of what its parent has accumulated."""
    own: Tensor | None
    """Of its own local difference; None: all."""

    def of(self, part: tuple[slice, slice]) -> "Charge":
        """Return the same of some of the nodes, rows and columns."""
        own = None if self.own is None else self.own[..., part[0], part[1]]
        return Charge(self.inherited[..., part[0], part[1]], own)


def changes(first: Tensor, second: Tensor) -> Tensor:
    """Return the squared difference of two lowpass planes (B, 3, h, w), (B, 1, h, w).

    Of light, summed over the cones: that of two equal nodes is exactly 0.
    """
    difference = first - second
    return (difference * difference).sum(1, keepdim=True)


def charge(
    change: Tensor, shifts: int, filtered: bool, items: int = 1, cached: bool = False
) -> Charge:
    """Return what every node of a level is charged.

    Parameters
    ----------
    change
        (B, 1, h, w): what `changes` gives for the nodes of a level.
    shifts
        As `Transform.shifts`.
    filtered
        Whether what is decomposed was filtered.
    items
        How many images lie below one another.
    cached
        As `Steps.cached`.
    """
    # Every image by itself.
    planes = change if items == 1 else apart(change[0, 0], items).unsqueeze(1)
    near, around = (_mean_around(planes, nodes * shifts, cached) for nodes in (NEAR, AROUND))
    ratio = near / around.clamp_min(torch.finfo(around.dtype).tiny)
    if items > 1:
        ratio = together(ratio.squeeze(1))[None, None]
    inherited = (ratio * (1.0 + SOFT) / (ratio + SOFT)).clamp_max(1.0)
    own = (ratio / FAINT).clamp_max(1.0) if filtered else None
    return Charge(inherited**POWER, None if own is None else own**POWER)


def _mean_around(plane: Tensor, nodes: int, cached: bool) -> Tensor:
    """Return the mean over so many nodes to each side, the border repeated."""
    padded = functional.pad(plane, (nodes,) * 4, mode="replicate")
    side = 2 * nodes + 1
    if not cached or plane.numel() <= SMALL:
        return functional.avg_pool2d(padded, side, 1)
    return _sums(_sums(padded, side, -1), side, -2) / float(side * side)


def _sums(plane: Tensor, side: int, dim: int) -> Tensor:
    """Return the sums of ``side`` successive numbers along a dimension, which it shortens.

    Of sums of 1, 2, 4 ... numbers: few passes, and nothing that cancels.
    """
    length = plane.shape[dim] - side + 1
    total, done, width = None, 0, 1
    while True:
        if side & width:
            part = plane.narrow(dim, done, length)
            total = part if total is None else total + part
            done += width
        if done == side:
            assert total is not None
            return total
        shorter = plane.shape[dim] - width
        plane = plane.narrow(dim, 0, shorter) + plane.narrow(dim, width, shorter)
        width *= 2
