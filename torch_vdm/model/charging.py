"""Which of its pixels a coarse difference is charged to.

A node of a coarse level spans many pixels, but usually few of them caused its difference. Going
down the quad-tree, every node inherits a share of what its parent has accumulated, according to
how much its own mean differs compared with the means around it: a coarse detail consists of these
means alone. Where two images are equal the share is exactly 0. Status of the whole file: choice,
ours.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.quadtree import surround
from torch_vdm.model.steps import PLAIN, Steps

# Radii of a node's neighbourhood and of its surroundings, in node widths. The second is as far as
# pooling and the lowpass of a parent spread the difference of a parent's neighbour: two nodes of
# the parent's level, and so five of its children's. Status: derived, for `Haar`.
NEAR, AROUND = 1, 5

# The ratio of the squared difference of a node's mean to that around it at which the base of the
# inherited share has fallen to half, and the power of that base. A ratio of 1 or more inherits all.
# Noise scatters from node to node, and gratings have zeros: these must keep what they have, within
# 3 % of the largest value, and the surroundings of a lamp must inherit nothing. Status: choice,
# measured.
SOFT, POWER = 0.005, 4

# Behind a filter a node may differ although its own light does not, because the filter spreads
# differences. Its own difference is charged in full where its light's squared difference is at
# least this fraction of the mean around it, and in proportion below that. Status: choice, measured.
FAINT = 0.1

# When computing in a cache, larger planes, in elements, are summed along one axis, then the other.
# Status: choice, measured.
SMALL = 2**10


class Charge(NamedTuple):
    """The shares that a node is charged, (B, 1, h, w), 0 to 1, of differences to the power of 6."""

    inherited: Tensor
    """The share of what its parent has accumulated."""
    own: Tensor | None
    """The share of its own local difference; None: all of it."""

    def of(self, part: tuple[slice, slice]) -> "Charge":
        """Return the charges of some rows and columns of the nodes."""
        own = None if self.own is None else self.own[..., part[0], part[1]]
        return Charge(self.inherited[..., part[0], part[1]], own)


def changes(first: Tensor, second: Tensor) -> Tensor:
    """Return the squared difference (B, 1, h, w) of two lowpass planes (B, 3, h, w).

    It is a difference of light, summed over the cones, and exactly 0 for two equal nodes.
    """
    difference = first - second
    return (difference * difference).sum(1, keepdim=True)


def charge(change: Tensor, shifts: int, filtered: bool, steps: Steps = PLAIN) -> Charge:
    """Return the shares that every node of a level is charged.

    Parameters
    ----------
    change
        (B, 1, h, w): what `changes` gives for the nodes of a level.
    shifts
        As `Transform.shifts`.
    filtered
        Whether the decomposed planes were filtered.
    steps
        How steps are called.
    """
    around = surround(change, AROUND * shifts, AROUND * shifts)
    charged: Charge = steps.valid(charge_within, around, shifts, filtered, steps.cached)
    return charged


def charge_within(around: Tensor, shifts: int, filtered: bool, cached: bool) -> Charge:
    """Return `charge` for planes with `AROUND` node widths around them, (B, 1, h, w) without.

    ``cached`` is as `Steps.cached`; other arguments are as in `charge`.
    """
    inner = (AROUND - NEAR) * shifts
    near = _mean(around[..., inner:-inner, inner:-inner], NEAR * shifts, cached)
    ratio = near / _mean(around, AROUND * shifts, cached).clamp_min(torch.finfo(near.dtype).tiny)
    inherited = (ratio * (1.0 + SOFT) / (ratio + SOFT)).clamp_max(1.0)
    own = (ratio / FAINT).clamp_max(1.0) if filtered else None
    return Charge(inherited**POWER, None if own is None else own**POWER)


def _mean(around: Tensor, nodes: int, cached: bool) -> Tensor:
    """Return the mean within a radius of ``nodes``, of all places that have so many around them."""
    side = 2 * nodes + 1
    if not cached or around.numel() <= SMALL:
        return functional.avg_pool2d(around, side, 1)
    return _sums(_sums(around, side, -1), side, -2) / float(side * side)


def _sums(plane: Tensor, side: int, dim: int) -> Tensor:
    """Return the sums of ``side`` successive elements along a dimension, which becomes shorter.

    They are built from sums of 1, 2, 4 ... elements: in few passes and without cancellation.
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
