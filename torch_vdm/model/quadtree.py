"""The quad-tree of the paper's Section 2: the only moves between a level and its neighbours.

A plane of h x w nodes has parents on a plane of ceil(h / 2) x ceil(w / 2) nodes. The parent of
node (x, y) is (x // 2, y // 2). A plane with an odd side is padded by repeating its last row or
column, level by level: padding the whole image to a square power of two would cost twice the
pixels at 1920 x 1080. Where a `Grid` puts a node before the first, there are ceil((h + 1) / 2), and
the parent of x is (x + 1) // 2.
"""

from torch import Tensor
from torch.nn import functional

from torch_vdm.model.grid import NONE, Before
from torch_vdm.model.interleave import interleaved

# Planes with no more elements are upsampled by torch's own operation, which is faster for them.
# Status: choice, measured.
SMALL = 2**15


def pad_even(plane: Tensor) -> Tensor:
    """Repeat the last row and column of ``plane`` (B, C, h, w) where h or w is odd."""
    height, width = plane.shape[-2:]
    if height % 2 == 0 and width % 2 == 0:
        return plane
    return functional.pad(plane, (0, width % 2, 0, height % 2), mode="replicate")


def surround(planes: Tensor, before: int = 1, after: int = 1) -> Tensor:
    """Repeat the border of planes (B, ..., h, w).

    It is repeated ``before`` times above and on the left, ``after`` times below and on the right.
    """
    if before == after == 0:
        return planes
    sides = before, after, before, after
    # torch repeats the last three dimensions of five.
    return functional.pad(planes, (*sides, *[0, 0] * (planes.ndim - 4)), mode="replicate")


def push(nodes: Tensor, size: tuple[int, int], before: Before = NONE) -> Tensor:
    """Give every child on a plane of ``size`` = (h, w) the value of its parent.

    ``nodes`` is (B, C, ..., ceil(h / 2), ceil(w / 2)), where h and w include what is put ``before``
    the first child; the root's plane, 1 x 1, is also its own parent plane. What is returned may be
    a view.
    """
    if nodes.numel() <= SMALL and nodes.is_floating_point():
        twice = (*[1.0] * (nodes.ndim - 4), 2.0, 2.0)
        children = functional.interpolate(nodes, scale_factor=twice)
    else:
        # Columns, then rows: faster than repeating elements along one axis and the other.
        rows = interleaved(nodes, nodes, -1).unsqueeze(-2)
        children = rows.expand(*rows.shape[:-2], 2, rows.shape[-1]).flatten(-3, -2)
    top, left = before
    return children[..., top : top + size[0], left : left + size[1]]
