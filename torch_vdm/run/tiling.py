"""Images larger than memory: where their tiles lie, and how a part of one is read."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from torch_vdm.model.grid import PAPERS, Grid

# Pixels a side of a tile. Status: choice; 1024 takes half a gigabyte with `Haar`.
TILE = 1024

# The smallest tile: it holds two nodes of one level. Status: choice.
SMALLEST_TILE = 4


class Source(Protocol):
    """An image, or a batch, that is read part by part: (3, H, W) or (B, 3, H, W).

    It may be a tensor, an array, a memory-mapped file (`numpy.load` with ``mmap_mode="r"``), an
    array of h5py or zarr, or any object with these two members. It has floating-point values as
    `VDM` takes them, or integers of 8 or 16 bits, which stand for 0 to 1.
    """

    @property
    def shape(self) -> Sequence[int]:
        """(3, H, W) or (B, 3, H, W)."""

    def __getitem__(self, index: Any, /) -> Any:
        """Return the part that slices select, as a tensor or what NumPy accepts as an array."""


Slices = tuple[slice, slice]


def _ends(side: slice) -> tuple[int, int]:
    return side.start, side.stop


class Tile(NamedTuple):
    """A part of an image, and the larger part that it is computed from."""

    part: Slices
    """Rows and columns of the image."""
    around: Slices
    """The same with its halo, as far as the image extends."""
    grid: Grid = PAPERS
    """Where the nodes lie on the image."""

    def within(self, node: int) -> Slices:
        """Return where the part lies on a plane of ``around`` with nodes of ``node`` pixels."""
        return self._scaled(node, (self.around[0].start, self.around[1].start))

    def of_image(self, node: int) -> Slices:
        """Return where the part lies on a plane of the image with nodes of ``node`` pixels."""
        return self._scaled(node, (0, 0))

    def _scaled(self, node: int, origin: tuple[int, int]) -> Slices:
        offsets = self.grid.offset(node.bit_length() - 1)
        rows, columns = (
            slice(
                (side.start + offset) // node - (begin + offset) // node,
                -(-(side.stop + offset) // node) - (begin + offset) // node,
            )
            for side, begin, offset in zip(self.part, origin, offsets, strict=True)
        )
        return rows, columns


@dataclass(frozen=True)
class Tiling:
    """How an image is cut.

    Attributes
    ----------
    size
        (H, W) of the image.
    sides
        Rows and columns of a tile.
    levels
        How many levels, from the finest, are computed in tiles; all others come from the whole
        image's lowpass pyramid.
    halo
        Pixels that a tile is computed with beyond each of its sides.
    grid
        Where the nodes lie on the image.
    """

    size: tuple[int, int]
    sides: tuple[int, int]
    levels: int
    halo: int
    grid: Grid = PAPERS

    @classmethod
    def fit(
        cls, size: tuple[int, int], tile: int, shifts: int, nodes: int, grid: Grid = PAPERS
    ) -> "Tiling":
        """Return a tiling of an image of ``size`` with tiles of at most ``tile`` pixels a side.

        The levels of tiles have ``shifts`` nodes per node width, and need ``nodes`` nodes around
        each. There are just enough of them to leave a plane no larger than a tile to the others,
        because the halo doubles with every level. Tiles and halos begin where the parents of the
        coarsest level do, as ``grid`` says, so that the levels of a tile are a part of the image's.
        """
        if not (isinstance(tile, int) and tile >= SMALLEST_TILE):
            raise ValueError(
                f"expected a tile of {SMALLEST_TILE} or more pixels a side, got {tile}"
            )
        wanted = 1 + (-(-max(size) // tile) - 1).bit_length()
        levels = min(wanted, tile.bit_length() - 2)
        parent = 2 ** (levels + 1)
        halo = -(-nodes // (2 * shifts)) * parent
        side = tile // parent * parent
        return cls(size, (side, side), levels, halo, grid)

    @classmethod
    def strips(
        cls,
        size: tuple[int, int],
        pixels: int,
        levels: int,
        shifts: int,
        nodes: int,
        grid: Grid = PAPERS,
    ) -> "Tiling":
        """Return a tiling by strips as wide as the image, of about so many pixels each.

        ``levels``, ``shifts``, ``nodes`` and ``grid`` are as in `fit`.
        """
        parent = 2 ** (levels + 1)
        halo = -(-nodes // (2 * shifts)) * parent
        # No thinner than so many halos, because halos are computed twice.
        rows = max(pixels // (size[1] * parent) * parent, 4 * halo)
        return cls(size, (rows, size[1]), levels, halo, grid)

    def plain(self, pixels: int) -> "Tiling":
        """Return the same tiling on the paper's grid, with halos wider by ``pixels`` or a few more.

        Its tiles begin at multiples of the node size of every level of theirs.
        """
        parent = 2 ** (self.levels + 1)
        return replace(self, halo=self.halo + -(-pixels // parent) * parent, grid=PAPERS)

    def wider(self, tile: Tile, pixels: int) -> Tile:
        """Return a tile with its halo as the part, and ``pixels`` or a few more around that.

        These begin and end where tiles of `plain` may.
        """
        parent = 2 ** (self.levels + 1)
        rows, columns = (
            slice(
                max((side.start - pixels) // parent * parent, 0),
                min(-(-(side.stop + pixels) // parent) * parent, length),
            )
            for side, length in zip(tile.around, self.size, strict=True)
        )
        return Tile(tile.around, (rows, columns))

    def grid_of(self, part: Slices) -> Grid:
        """Return the grid of a part that begins where tiles do, for their levels."""
        if self.whole:
            return self.grid
        return self.grid.part((part[0].start, part[1].start), self.levels + 1)

    def new_plane(self, like: Tensor, node: int) -> Tensor:
        """Return an empty plane (B, C, h, w) of the image with nodes of ``node`` pixels.

        ``like``: that of a tile.
        """
        image = slice(0, self.size[0]), slice(0, self.size[1])
        rows, columns = Tile(image, image, self.grid).of_image(node)
        return like.new_empty(*like.shape[:-2], rows.stop, columns.stop)

    def split_rows(self, image: Tensor) -> Iterator[Tensor]:
        """Yield the rows of an image (B, C, H, W) that each strip is computed from.

        The image is cut once and its pieces are joined, so that a gradient comes back in one piece.
        """
        edges = sorted({edge for strip in self for edge in _ends(strip.around[0])})
        parts = image.split([end - begin for begin, end in pairwise(edges)], -2)
        for strip in self:
            first, last = (edges.index(edge) for edge in _ends(strip.around[0]))
            yield torch.cat(parts[first:last], -2)

    @property
    def whole(self) -> bool:
        """Whether the image is no larger than a tile."""
        return all(side <= most for side, most in zip(self.size, self.sides, strict=True))

    def __len__(self) -> int:
        """Return the number of tiles."""
        return len(self._parts(0)) * len(self._parts(1))

    def __iter__(self) -> Iterator[Tile]:
        """Yield the tiles, row by row."""
        height, width = self.size
        for rows in self._parts(0):
            for columns in self._parts(1):
                around = self._wider(rows, height), self._wider(columns, width)
                yield Tile((rows, columns), around, self.grid)

    def _parts(self, axis: int) -> list[slice]:
        """Return where tiles begin and end along a side, which is not cut if it is no longer."""
        length, most = self.size[axis], self.sides[axis]
        if length <= most:
            return [slice(0, length)]
        offset = self.grid.offset(self.levels + 1)[axis]
        edges = [0, *range(most - offset, length, most), length]
        return [slice(begin, end) for begin, end in pairwise(edges)]

    def _wider(self, side: slice, length: int) -> slice:
        return slice(max(side.start - self.halo, 0), min(side.stop + self.halo, length))


def cut(plane: Tensor, part: Slices) -> Tensor:
    """Return a part of a plane (B, C, h, w)."""
    return plane[..., part[0], part[1]].contiguous()


def read(source: Source, item: int, part: Slices) -> Tensor:
    """Return a part of an item of a source, (1, 3, h, w), in floating point."""
    index = (slice(None), *part) if len(source.shape) == 3 else (item, slice(None), *part)
    pixels = source[index]
    # A copy: the pages of a memory-mapped file need not stay, and it may be read-only.
    image = pixels if isinstance(pixels, Tensor) else torch.from_numpy(np.array(pixels))
    if image.dtype in (torch.uint8, torch.uint16):
        image = image.to(torch.float32) / torch.iinfo(image.dtype).max
    return image.unsqueeze(0)


def whole(source: Source) -> Tensor:
    """Return all of a source (3, H, W) as (1, 3, H, W)."""
    height, width = source.shape[-2:]
    return read(source, 0, (slice(0, height), slice(0, width)))


def check_sources(test: Source, reference: Source) -> tuple[int, tuple[int, int]]:
    """Return the number of items and (H, W) of two sources of one shape; refuse others."""
    for name, source in (("test", test), ("reference", reference)):
        if not hasattr(source, "shape"):
            raise ValueError(
                f"expected a {name} of shape (3, H, W) or (B, 3, H, W), got {type(source).__name__}"
            )
    shapes = [tuple(int(side) for side in source.shape) for source in (test, reference)]
    for name, shape in zip(("test", "reference"), shapes, strict=True):
        if len(shape) not in (3, 4) or shape[-3] != 3 or 0 in shape:
            raise ValueError(
                f"expected a {name} of shape (3, H, W) or (B, 3, H, W) with no side of 0, "
                f"got {shape}"
            )
    if shapes[0] != shapes[1]:
        raise ValueError(f"expected two images of one shape, got {shapes[0]} and {shapes[1]}")
    height, width = shapes[0][-2:]
    return (1 if len(shapes[0]) == 3 else shapes[0][0]), (height, width)
