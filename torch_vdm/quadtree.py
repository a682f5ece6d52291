"""The quad-tree of the paper's Section 2: the only moves between a level and its neighbours.

A plane of h x w nodes has parents on a plane of ceil(h / 2) x ceil(w / 2) nodes. The parent of
node (x, y) is (x // 2, y // 2). A plane with an odd side is padded by repeating its last row or
column, level by level: padding the whole image to a square power of two would cost twice the
pixels at 1920 x 1080. Several trees may lie below one another in one plane.
"""

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.interleave import interleaved

# Planes with no more numbers are enlarged by torch's own operation, which is faster for them.
# Status: choice, measured.
SMALL = 2**15


def pad_even(plane: Tensor) -> Tensor:
    """Repeat the last row and column of ``plane`` (B, C, h, w) where h or w is odd."""
    height, width = plane.shape[-2:]
    if height % 2 == 0 and width % 2 == 0:
        return plane
    return functional.pad(plane, (0, width % 2, 0, height % 2), mode="replicate")


def share(side: int, node: int) -> float:
    """Return the share of its pixels that the last of the nodes of a side of pixels has."""
    return (side % node or node) / node


def complete(plane: Tensor, size: tuple[int, int], node: int) -> Tensor:
    """Pad ``plane`` to even sides so that no pixel weighs more than another in the details.

    ``plane`` (B, C, h, w) holds the means of nodes of ``node`` x ``node`` pixels, a power of two,
    of an image of ``size`` = (H, W) pixels. The last row or column R may hold only the share r of
    its pixels: it becomes L + r (R - L), as if the pixels that it lacks were like L, the one before
    it. Where it has no sibling it gets L for one, so that its details are those of a window over
    the border. The lowpass then is not that of the node's own pixels; see `own`.
    """
    for side, axis in zip(size, (-2, -1), strict=True):
        nodes, real = plane.shape[axis], share(side, node)
        if nodes == 1 or (nodes % 2 == 0 and real == 1.0):
            continue
        before, last = plane.narrow(axis, nodes - 2, 1), plane.narrow(axis, nodes - 1, 1)
        columns = [plane.narrow(axis, 0, nodes - 1), before + real * (last - before)]
        plane = torch.cat([*columns, before] if nodes % 2 == 1 else columns, axis)
    return pad_even(plane)


def own(lowpass: Tensor, plane: Tensor, size: tuple[int, int], node: int) -> Tensor:
    """Give the border nodes the mean of their own pixels.

    ``lowpass`` (B, C, h / 2, w / 2) is that of Eq. 2 from a `complete` ``plane``, which is given
    as it was before, (B, C, h, w); ``size`` and ``node`` as there.
    """
    for axis, other in ((-1, -2), (-2, -1)):
        nodes = plane.shape[axis]
        if nodes == 1 or (nodes % 2 == 0 and share(size[axis], node) == 1.0):
            continue
        count = 2 - nodes % 2
        border = plane.narrow(axis, nodes - count, count)
        for along in (axis, other):
            border = _means(border, along, share(size[along], node))
        inner = lowpass.narrow(axis, 0, lowpass.shape[axis] - 1)
        lowpass = torch.cat((inner, border), axis)
    return lowpass


def _means(plane: Tensor, axis: int, real: float) -> Tensor:
    """Return the means of pairs of nodes along an axis; the last node has the share ``real``."""
    nodes = plane.shape[axis]
    first = plane[..., 0::2] if axis == -1 else plane[..., 0::2, :]
    second = plane[..., 1::2] if axis == -1 else plane[..., 1::2, :]
    paired = second.shape[axis]
    means = 0.5 * (first.narrow(axis, 0, paired) + second)
    if nodes % 2 == 1:
        return torch.cat((means, first.narrow(axis, paired, 1)), axis)
    before, last = first.narrow(axis, paired - 1, 1), second.narrow(axis, paired - 1, 1)
    weighed = (before + real * last) / (1.0 + real)
    return torch.cat((means.narrow(axis, 0, paired - 1), weighed), axis)


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


def push(nodes: Tensor, size: tuple[int, int], items: int = 1) -> Tensor:
    """Give every child on a plane of ``size`` = (h, w) the value of its parent.

    ``nodes`` is (B, C, ..., ceil(h / 2), ceil(w / 2)); the root's plane, 1 x 1, is also its own
    parent plane. Of ``items`` trees below one another ``size`` is that of all of them.
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
    if items > 1:
        return together(apart(children, items)[..., : size[0] // items, : size[1]].contiguous())
    return children[..., : size[0], : size[1]].contiguous()
