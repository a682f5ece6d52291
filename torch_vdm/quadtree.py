"""The quad-tree of the paper's Section 2: the only moves between a level and its neighbours.

A plane of h x w nodes has parents on a plane of ceil(h / 2) x ceil(w / 2) nodes. The parent of
node (x, y) is (x // 2, y // 2). A plane with an odd side is padded by repeating its last row or
column, level by level: padding the whole image to a square power of two would cost twice the
pixels at 1920 x 1080.
"""

import torch
from torch import Tensor
from torch.nn import functional


def pad_even(plane: Tensor) -> Tensor:
    """Repeat the last row and column of ``plane`` (B, C, h, w) where h or w is odd."""
    height, width = plane.shape[-2:]
    if height % 2 == 0 and width % 2 == 0:
        return plane
    return functional.pad(plane, (0, width % 2, 0, height % 2), mode="replicate")


def complete(plane: Tensor, size: tuple[int, int], node: int) -> Tensor:
    """Pad ``plane`` to even sides so that no pixel weighs more than another.

    ``plane`` (B, C, h, w) holds the means of nodes of ``node`` x ``node`` pixels, a power of two,
    of an image of ``size`` = (H, W) pixels. The last row or column R may hold only the share r of
    its pixels. As a second sibling, after L, it becomes L + 2 r / (1 + r) (R - L): (L + R) / 2 is
    then the mean of the real pixels of both. As a first it gets, in the place of the sibling that
    it lacks, R + 2 r / (1 + r) (L - R), so that its details are those of a window over the border
    and L, its neighbour. In both the detail tends to 0 with r.

    The lowpass of a window is not that of its node; see `own`.
    """
    for side, axis in zip(size, (-2, -1), strict=True):
        nodes = plane.shape[axis]
        share = (side % node or node) / node
        if nodes == 1 or (nodes % 2 == 0 and share == 1.0):
            continue
        before, last = plane.narrow(axis, nodes - 2, 1), plane.narrow(axis, nodes - 1, 1)
        step = 2.0 * share / (1.0 + share) * (last - before)
        if nodes % 2 == 0:
            plane = torch.cat((plane.narrow(axis, 0, nodes - 1), before + step), axis)
        else:
            plane = torch.cat((plane, last - step), axis)
    return pad_even(plane)


def own(lowpass: Tensor, details: Tensor, size: tuple[int, int]) -> Tensor:
    """Give the border nodes of a decomposed `complete` plane the mean of their own pixels.

    ``lowpass`` (B, C, h / 2, w / 2) and ``details`` (B, C, 3, h / 2, w / 2) are those of Eq. 2;
    ``size`` is (h, w) before it was completed. The first sibling alone is the sum of the lowpass
    and the detail.
    """
    horizontal, vertical, diagonal = details.unbind(2)
    if size[1] % 2 == 1:
        alone = lowpass[..., -1:] + horizontal[..., -1:]
        lowpass = torch.cat((lowpass[..., :-1], alone), -1)
        vertical = torch.cat(
            (vertical[..., -1:, :-1], vertical[..., -1:, -1:] + diagonal[..., -1:, -1:]), -1
        )
    if size[0] % 2 == 1:
        alone = lowpass[..., -1:, :] + vertical[..., -1:, :]
        lowpass = torch.cat((lowpass[..., :-1, :], alone), -2)
    return lowpass


def push(nodes: Tensor, size: tuple[int, int]) -> Tensor:
    """Give every child on a plane of ``size`` = (h, w) the value of its parent.

    ``nodes`` is (B, C, ceil(h / 2), ceil(w / 2)); the root's plane, 1 x 1, is also its own
    parent plane.
    """
    children = nodes.repeat_interleave(2, -2).repeat_interleave(2, -1)
    return children[..., : size[0], : size[1]].contiguous()
