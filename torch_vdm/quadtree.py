"""The quad-tree of the paper's Section 2: the only moves between a level and its neighbours.

A plane of h x w nodes has parents on a plane of ceil(h / 2) x ceil(w / 2) nodes. The parent of
node (x, y) is (x // 2, y // 2). A plane with an odd side is padded by repeating its last row or
column, level by level: padding the whole image to a square power of two would cost twice the
pixels at 1920 x 1080.
"""

from torch import Tensor
from torch.nn import functional


def pad_even(plane: Tensor) -> Tensor:
    """Repeat the last row and column of ``plane`` (B, C, h, w) where h or w is odd."""
    height, width = plane.shape[-2:]
    if height % 2 == 0 and width % 2 == 0:
        return plane
    return functional.pad(plane, (0, width % 2, 0, height % 2), mode="replicate")


def push(nodes: Tensor, size: tuple[int, int]) -> Tensor:
    """Give every child on a plane of ``size`` = (h, w) the value of its parent.

    ``nodes`` is (B, C, ceil(h / 2), ceil(w / 2)); the root's plane, 1 x 1, is also its own
    parent plane.
    """
    children = nodes.repeat_interleave(2, -2).repeat_interleave(2, -1)
    return children[..., : size[0], : size[1]].contiguous()
