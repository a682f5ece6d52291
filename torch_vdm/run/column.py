"""The nodes of several levels in one column: an operation is then called once for all of them.

A column is (..., N, 1): the nodes of the levels one after the other, the coarsest level first. What
needs neighbours gets the levels as cells of one plane instead, each with its ring around it.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_vdm.model.grid import Before
from torch_vdm.run.stacked import unviewed

# (h, w) of each level.
Sizes = tuple[tuple[int, int], ...]


class Column(NamedTuple):
    """Where the nodes of levels lie in a column."""

    sizes: Sizes
    level: Tensor
    """(N,): the number of each node's level."""
    parent: Tensor
    """(N, 1): where each node's parent lies in a column of the planes of parents."""

    def planes(self, column: Tensor) -> list[Tensor]:
        """Return the planes (..., h, w) of all levels in a column."""
        return apart(column, self.sizes)

    def of_parents(self, column: Tensor) -> Tensor:
        """Return a column in which every node has the value of its parent in another."""
        return at(column, self.parent)


class Cells(NamedTuple):
    """Where levels lie on one plane, with their borders repeated around them."""

    nodes: Tensor
    """(h, w): which place of the column lies where; between the levels, any."""
    places: Tensor
    """(N, 1): where the nodes of the column lie on a plane that has lost the levels' rings."""

    def of(self, column: Tensor) -> Tensor:
        """Return the plane (..., h, w) of a column."""
        return at(column, self.nodes)

    def column(self, valid: Tensor) -> Tensor:
        """Return the column of a plane (..., h, w) that has lost the levels' rings."""
        # All at once: the gradient of a slice for each level is a plane for each of them.
        return at(valid, self.places)


def joined(planes: Sequence[Tensor]) -> Tensor:
    """Return planes (..., h, w) of levels in a column."""
    return torch.cat([plane.flatten(-2).unsqueeze(-1) for plane in planes], -2)


def apart(column: Tensor, sizes: Sizes) -> list[Tensor]:
    """Return the planes (..., h, w) of levels in a column."""
    parts = column.squeeze(-1).split([math.prod(size) for size in sizes], -1)
    return [part.unflatten(-1, size) for part, size in zip(parts, sizes, strict=True)]


def at(plane: Tensor, places: Tensor) -> Tensor:
    """Return the values (..., h, w) of a column, or of a plane row by row, at places (h, w)."""
    # Selecting from two dimensions is much faster than from more.
    found = plane.flatten(-2).flatten(0, -2).index_select(1, places.flatten())
    return unviewed(found, (*plane.shape[:-2], *places.shape))


def column_of(
    sizes: Sizes, before: Sequence[Before], like: Tensor, parents: Sizes | None = None
) -> Column:
    """Return the column of the coarsest levels on the device of a plane.

    ``before``: for each level, how many nodes are put before its first to find their parents.
    ``parents``: the sizes of the planes that hold these, those of the levels by default; the first
    is that of level 0, and of level 1.
    """
    column: Column = kept_for(like)(_column, sizes, tuple(before), like.device, parents or sizes)
    return column


def cells_of(sizes: Sizes, ring: tuple[int, int], like: Tensor) -> Cells:
    """Return the cells of levels, with so many nodes before and after each, in y and in x."""
    cells: Cells = kept_for(like)(_cells, sizes, ring, like.device)
    return cells


def kept_for(like: Tensor) -> Callable[..., Any]:
    """Return what calls a function, and keeps the result if that can be used in other calls."""
    if type(like) is Tensor and not torch.compiler.is_compiling():
        return _kept
    return lambda function, *arguments: function(*arguments)


# Those of a 4K image take 100 MB together. Status: choice.
@lru_cache(maxsize=32)
def _kept(function: Callable[..., Any], *arguments: Any) -> Any:
    # Nothing of the call in which it is made, which may be transformed, is kept.
    with torch.inference_mode(False), torch._C._DisableFuncTorch():
        return function(*arguments)


def _column(sizes: Sizes, before: Sequence[Before], device: torch.device, parents: Sizes) -> Column:
    counts = [math.prod(size) for size in sizes]
    starts = np.cumsum([0, *map(math.prod, parents)])
    places: list[NDArray[np.int64]] = []
    for number, ((height, width), (top, left)) in enumerate(zip(sizes, before, strict=True)):
        above = max(number - 1, 0)
        rows, columns = (np.arange(height) + top) // 2, (np.arange(width) + left) // 2
        inside = rows[:, None] * parents[above][1] + columns
        places.append((starts[above] + inside).flatten())
    level = np.repeat(np.arange(len(sizes)), counts)
    found = level, np.concatenate(places)[:, None]
    return Column(sizes, *(torch.from_numpy(each).to(device) for each in found))


def _cells(sizes: Sizes, ring: tuple[int, int], device: torch.device) -> Cells:
    around = sum(ring)
    sides = [(height + around, width + around) for height, width in sizes]
    corners = min((_beside(sides), _below(sides), _in_two(sides)), key=lambda c: _area(sides, c))
    rows_and_columns = _extent(sides, corners)
    nodes = np.zeros(rows_and_columns, np.int64)
    places: list[NDArray[np.int64]] = []
    start = 0
    for (height, width), (y, x) in zip(sizes, corners, strict=True):
        rows, columns = (
            np.clip(np.arange(-ring[0], side + ring[1]), 0, side - 1) for side in (height, width)
        )
        inside = start + rows[:, None] * width + columns
        nodes[y : y + height + around, x : x + width + around] = inside
        across = rows_and_columns[1] - around
        places.append(
            ((np.arange(y, y + height) * across)[:, None] + np.arange(x, x + width)).flatten()
        )
        start += height * width
    found = nodes, np.concatenate(places)[:, None]
    return Cells(*(torch.from_numpy(each).to(device) for each in found))


Corners = tuple[tuple[int, int], ...]


def _beside(sides: Sizes | list[tuple[int, int]]) -> Corners:
    """Return the corners of cells beside one another."""
    columns = np.cumsum([0, *(width for _, width in sides)]).tolist()
    return tuple((0, x) for x in columns[:-1])


def _below(sides: Sizes | list[tuple[int, int]]) -> Corners:
    """Return the corners of cells below one another."""
    rows = np.cumsum([0, *(height for height, _ in sides)]).tolist()
    return tuple((y, 0) for y in rows[:-1])


def _in_two(sides: Sizes | list[tuple[int, int]]) -> Corners:
    """Return the corners of the finest level and, beside it, all others below one another."""
    return (*((y, sides[-1][1]) for y, _ in _below(sides[:-1])), (0, 0))


def _extent(sides: list[tuple[int, int]], corners: Corners) -> tuple[int, int]:
    """Return rows and columns of the plane that cells lie on."""
    ends = [(y + h, x + w) for (h, w), (y, x) in zip(sides, corners, strict=True)]
    return max(y for y, _ in ends), max(x for _, x in ends)


def _area(sides: list[tuple[int, int]], corners: Corners) -> int:
    return math.prod(_extent(sides, corners))
