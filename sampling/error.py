"""The trees of local, maximum and total error.

"Local visual difference prediction" and "update maximum error tree" of Fig. 8. The local errors
come from `VDM.local_differences`, in JND to the power of the summation exponent.
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.grid import Grid
from torch_vdm.model.quadtree import push


def maximum(local: Sequence[Tensor], grid: Grid) -> tuple[Tensor, ...]:
    """Return for each node its local error plus the largest maximum among its children.

    Parameters
    ----------
    local
        One (B, 1, h, w) per level, level 0 (the root) first; not negative.
    grid
        Where the nodes lie.

    Returns
    -------
    tuple of Tensor
        The same shapes. Level 0: the largest error along any path of the tree.
    """
    levels = [local[-1]]
    for octave, nodes in enumerate(reversed(local[:-1]), 1):
        top, left = grid.before(octave)
        children = functional.pad(levels[-1], (left, 0, top, 0)) if top or left else levels[-1]
        levels.append(nodes + functional.max_pool2d(children, 2, ceil_mode=True))
    return tuple(reversed(levels))


def total(local: Sequence[Tensor], largest: Sequence[Tensor], grid: Grid) -> tuple[Tensor, ...]:
    """Return for each node the local errors on the path to it plus its maximum error.

    Parameters
    ----------
    local
        One (B, 1, h, w) per level, level 0 first.
    largest
        What `maximum` returns for it.
    grid
        Where the nodes lie.

    Returns
    -------
    tuple of Tensor
        The same shapes. Level 0, and the maximum of each level, equal the maximum of the tree; the
        finest level is the error accumulated down every path.
    """
    levels: list[Tensor] = []
    above = torch.zeros_like(local[0])
    for nodes, below, before in zip(local, largest, grid.down(len(local)), strict=True):
        size = (nodes.shape[-2], nodes.shape[-1])
        path = push(above, size, before=before) if levels else above
        levels.append(path + below)
        above = path + nodes
    return tuple(levels)
