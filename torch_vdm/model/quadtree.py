"""The quad-tree of the paper's Section 2: the only moves between a level and its neighbours.

A plane of h x w nodes has parents on a plane of ceil(h / 2) x ceil(w / 2) nodes. The parent of
node (x, y) is (x // 2, y // 2). A plane with an odd side is padded by repeating its last row or
column, level by level: padding the whole image to a square power of two would cost twice the
pixels at 1920 x 1080. Where a `Grid` puts a node before the first, it is ceil((h + 1) / 2), and the
parent of x is (x + 1) // 2. Several trees may lie below one another in one plane.
"""

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.grid import NONE, Before, Side
from torch_vdm.model.interleave import interleaved

# Planes with no more numbers are enlarged by torch's own operation, which is faster for them.
# Status: choice, measured.
SMALL = 2**15


def pad_even(plane: Tensor) -> Tensor:
    """Repeat the last row and column of ``plane`` (B, C, h, w) where h or w is odd."""
    height, width = plane.shape[-2:]
    if height % 2 == 0 and width % 2 == 0:
        return plane
    return functional.pad(plane, (0, width % 2, 0, height % 2), mode="replicate")


def complete(plane: Tensor, sides: tuple[Side, Side]) -> Tensor:
    """Pad ``plane`` to even sides so that no pixel weighs more than another in the details.

    ``plane`` (B, C, h, w) holds the means of nodes, which lie as ``sides`` say. The last row or
    column R may hold only the share r of its pixels: it becomes L + r (R - L), as if the pixels
    that it lacks were like L, the one before it. Where it has no sibling it gets L for one, so that
    its details are those of a window over the border. The first row and column likewise. Where two
    nodes are all that there is, they keep the mean of their pixels and differ by the smaller share.
    The lowpass then is not that of the nodes' own pixels; see `own`.
    """
    for side, axis in zip(sides, (-2, -1), strict=True):
        plane = _weakened(plane, axis, side)
        nodes = plane.shape[axis]
        if nodes == 1:
            continue
        # What has no sibling gets the node beside it for one.
        front = plane.narrow(axis, 1, 1) if side.before == 1 else None
        odd = (nodes + side.before) % 2 == 1
        plane = _joined(front, plane, plane.narrow(axis, nodes - 2, 1) if odd else None, axis)
    return pad_even(plane)


def _weakened(plane: Tensor, axis: int, side: Side) -> Tensor:
    """Return a plane whose first and last node along an axis count for the pixels they have."""
    nodes = plane.shape[axis]
    if nodes == 1 or side.first == side.last == 1.0:
        return plane
    first, last = plane.narrow(axis, 0, 1), plane.narrow(axis, nodes - 1, 1)
    if nodes == 2:
        between, half = last - first, 0.5 * min(side.first, side.last)
        down, up = (share / (side.first + side.last) - half for share in (side.last, side.first))
        return torch.cat((first + down * between, last - up * between), axis)
    if side.first < 1.0:
        beside = plane.narrow(axis, 1, 1)
        first = beside + side.first * (first - beside)
    if side.last < 1.0:
        beside = plane.narrow(axis, nodes - 2, 1)
        last = beside + side.last * (last - beside)
    return torch.cat((first, plane.narrow(axis, 1, nodes - 2), last), axis)


def own(lowpass: Tensor, plane: Tensor, sides: tuple[Side, Side]) -> Tensor:
    """Give the border nodes the mean of their own pixels.

    ``lowpass`` (B, C, h / 2, w / 2) is that of Eq. 2 from a `complete` ``plane``, which is given
    as it was before, (B, C, h, w); ``sides`` as there.
    """
    for axis, other in ((-1, -2), (-2, -1)):
        first, last = (
            None if end is None else _means(end, other, sides[other])
            for end in _ends(plane, axis, sides[axis])
        )
        begin, given = (0 if first is None else 1), sum(end is not None for end in (first, last))
        inner = lowpass.narrow(axis, begin, lowpass.shape[axis] - given) if given else lowpass
        lowpass = _joined(first, inner, last, axis)
    return lowpass


def _means(plane: Tensor, axis: int, side: Side) -> Tensor:
    """Return the means of the pixels of every parent along an axis."""
    nodes = plane.shape[axis]
    if nodes == 1:
        return plane
    first, last = _ends(plane, axis, side)
    begin = 0 if first is None else 2 - side.before
    end = nodes if last is None else nodes - 2 + (nodes + side.before) % 2
    pairs = plane.narrow(axis, begin, end - begin)
    if axis == -1:
        one, two = pairs[..., 0::2], pairs[..., 1::2]
    else:
        one, two = pairs[..., 0::2, :], pairs[..., 1::2, :]
    return _joined(first, 0.5 * (one + two), last, axis)


def _ends(plane: Tensor, axis: int, side: Side) -> tuple[Tensor | None, Tensor | None]:
    """Return the means of the pixels of the first and the last parent along an axis.

    None where that is the mean of two nodes; of a parent that is alone as the last.
    """
    nodes = plane.shape[axis]
    if nodes == 1:
        return None, None
    far = plane.narrow(axis, 0, 1), plane.narrow(axis, 1, 1)
    near = plane.narrow(axis, nodes - 2, 1), plane.narrow(axis, nodes - 1, 1)
    if nodes == 2 and side.before == 0:
        return None, _mean(*near, side.first, side.last)
    first = far[0] if side.before == 1 else _mean(*far, side.first, 1.0)
    last = near[1] if (nodes + side.before) % 2 == 1 else _mean(*near, 1.0, side.last)
    return first, last


def _mean(one: Tensor, two: Tensor, first: float, last: float) -> Tensor | None:
    """Return the mean of two nodes that have these shares of their pixels; None of whole ones."""
    if first == last == 1.0:
        return None
    if first == 1.0:
        return (one + last * two) / (1.0 + last)
    # Exactly their own where they are equal.
    return two + first / (first + last) * (one - two)


def _joined(first: Tensor | None, plane: Tensor, last: Tensor | None, axis: int) -> Tensor:
    """Return a plane with a row or column before and after it, where they are given."""
    given = [part for part in (first, plane, last) if part is not None]
    return torch.cat(given, axis) if len(given) > 1 else plane


def stacked(batch: Tensor) -> Tensor:
    """Return the items of a batch (B, C, h, w) below one another, (1, C, B h, w)."""
    return together(batch.transpose(0, 1)).unsqueeze(0)


def apart(planes: Tensor, items: int) -> Tensor:
    """Return what lies below one another, (..., items h, w), as (..., items, h, w)."""
    items_apart: Tensor = planes.unflatten(-2, (items, -1))
    return items_apart


def together(planes: Tensor) -> Tensor:
    """Return (..., items, h, w) below one another, (..., items h, w): the inverse of `apart`."""
    return planes.flatten(-3, -2)


def push(nodes: Tensor, size: tuple[int, int], items: int = 1, before: Before = NONE) -> Tensor:
    """Give every child on a plane of ``size`` = (h, w) the value of its parent.

    ``nodes`` is (B, C, ..., ceil(h / 2), ceil(w / 2)), or so for h and w with what is put
    ``before`` the first child; the root's plane, 1 x 1, is also its own parent plane. Of ``items``
    trees below one another ``size`` is that of all of them.
    """
    if nodes.numel() <= SMALL and nodes.is_floating_point():
        twice = (*[1.0] * (nodes.ndim - 4), 2.0, 2.0)
        children = functional.interpolate(nodes, scale_factor=twice)
    else:
        # Columns, then rows: faster than repeating elements along one side and the other.
        rows = interleaved(nodes, nodes, -1).unsqueeze(-2)
        children = rows.expand(*rows.shape[:-2], 2, rows.shape[-1]).flatten(-3, -2)
    if (children.shape[-2], children.shape[-1]) == size:
        return children  # no view, on which compiled code would be specialised
    top, left = before
    bottom, right = top + size[0] // items, left + size[1]
    if items > 1:
        return together(apart(children, items)[..., top:bottom, left:right].contiguous())
    return children[..., top:bottom, left:right].contiguous()
