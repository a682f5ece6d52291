"""Images larger than memory, one tile at a time.

A tile begins where a parent of the coarsest level that it is cut for begins, and comes with all
that its nodes, their parents and their neighbours in pooling are computed from. Its levels are then
a part of the image's, and everything around it is cut off. The coarser levels continue from a plane
that the tiles leave, no larger than one of them.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.charging import AROUND
from torch_vdm.model.cortex import Cortex, bands
from torch_vdm.model.cortex.haar import lowpass_of_light
from torch_vdm.model.cortex.transform import Base
from torch_vdm.model.distance import accumulate, just_noticeable
from torch_vdm.model.grid import Grid
from torch_vdm.model.model import Model
from torch_vdm.precision import widest
from torch_vdm.run.schedule import Schedule
from torch_vdm.run.tiling import Slices, Source, Tile, Tiling, check_sources, cut, read
from torch_vdm.run.whole import compared, descended, differences

# Called with the number of steps done, and the number of all steps.
Progress = Callable[[int, int], None]

# Takes parts of a test and a reference, (1, 3, h, w), and the item, y and x of their first pixel;
# returns both as the model takes them, and where they are finite, if that is wanted.
Check = Callable[[Tensor, Tensor, tuple[int, int, int]], tuple[Tensor, Tensor, Tensor | None]]


class Done(NamedTuple):
    """A tile, and what has accumulated down the paths to its leaves, (1, 1, h, w)."""

    item: int
    part: Slices
    grid: Grid
    total: Tensor
    seen: Tensor | None

    def jnd(self, model: Model) -> Tensor:
        """Return the map (1, 1, h, w) of the tile."""
        jnd = just_noticeable(self.total, model.constants["summation_exponent"])
        rows, columns = self.part
        size = rows.stop - rows.start, columns.stop - columns.start
        return model.to_pixels(jnd, size, self.grid)


class _Pair(NamedTuple):
    """The same part of a test and a reference."""

    planes: list[Tensor]
    """The cone responses to each."""
    seen: Tensor | None
    """Where both are finite, if that is wanted."""


def in_tiles(
    model: Model,
    schedule: Schedule,
    sources: tuple[Source, Source],
    side: int,
    check: Check,
    square: int = 1,
    progress: Progress | None = None,
) -> Iterator[Done]:
    """Yield what accumulates down the paths to the leaves of every tile of a test and a reference.

    ``side``: the largest side of a tile, in pixels. ``square``: parts are checked in whole squares
    of so many pixels a side. ``progress`` is as in `VDM.tiled`.
    """
    items, size = check_sources(*sources)
    transform, shifts = model.transform, model.transform.shifts
    # Spatial pooling needs fewer nodes than charging does.
    nodes = transform.reach + AROUND * shifts
    grid = model.grid(size)
    tiling = Tiling.fit(size, side, shifts, nodes, grid)
    filtered = transform.csf == "filter" and not tiling.whole
    plain = tiling.plain(bands.halo(_scales(tiling)))
    device = model.constants["summation_exponent"].device
    steps = count(1)
    passes = len(tiling) * (1 if tiling.whole else 2) + filtered * len(plain)

    def images(item: int, part: Slices) -> _Pair:
        wide = _in_squares(part, size, square)
        one, other = (read(source, item, wide).to(device) for source in sources)
        one, other, seen = check(one, other, (item, wide[0].start, wide[1].start))
        if wide != part:
            inside = Tile(part, wide).within(1)
            one, other = cut(one, inside), cut(other, inside)
            seen = None if seen is None else cut(seen, inside)
        return _Pair([model.cone_planes(one), model.cone_planes(other)], seen)

    def step() -> None:
        if progress is not None:
            progress(next(steps), items * passes)

    for item in range(items):
        read_part = partial(images, item)
        contrasts: list[Tensor] | None = None
        coarse = None
        if filtered:
            contrasts = _coarse_contrasts(model, schedule, read_part, plain, step)
        if not tiling.whole:
            representations = _coarse(model, schedule, read_part, tiling, contrasts, step)
            coarse = compared(model, schedule, *representations)
        for tile in tiling:
            around = _around(tile, tiling, contrasts)
            planes, seen = read_part(around.part)
            first, second = (
                _decomposed(model, cones, contrast, around.inner, tiling.grid_of(tile.around))
                for cones, contrast in zip(planes, around.contrasts, strict=True)
            )
            paths = differences(model, schedule, first, second)
            part_grid = tiling.grid_of(tile.part)
            if coarse is None:
                total = descended(model, schedule, paths, first.before)
                yield Done(item, tile.part, part_grid, total, seen)
                step()
                continue
            fine = slice(-tiling.levels, None)
            total = within_tile(model, tiling, tile, paths.local[fine], paths.changes[fine], coarse)
            seen = None if seen is None else cut(seen, around.pixels)
            yield Done(item, tile.part, part_grid, total, seen)
            step()


def within_tile(
    model: Model,
    tiling: Tiling,
    tile: Tile,
    local: Sequence[Tensor],
    changes: Sequence[Tensor],
    coarse: Tensor,
) -> Tensor:
    """Return what accumulates down the paths to the leaves of a tile, (1, 1, h, w).

    ``local`` and ``changes`` are those of the tile's levels, the coarsest first, with what is
    around it; ``coarse`` is what the whole image has accumulated above these levels.
    """
    shifts = model.transform.shifts
    places = [tile.within(2 ** (level + 1) // shifts) for level in range(tiling.levels)][::-1]
    charges = model.charges(changes)
    if charges is not None:
        charges = [charge.of(place) for charge, place in zip(charges, places, strict=True)]
    return accumulate(
        list(map(cut, local, places)),
        cut(coarse, tile.of_image(2 ** (tiling.levels + 1) // shifts)),
        before=tiling.grid_of(tile.part).down(tiling.levels),
        charges=charges,
    )


def _decomposed(
    model: Model, planes: Tensor, coarser: Tensor | None, part: Slices | None, grid: Grid
) -> Cortex:
    """Return the cortex representation of a ``part`` of cone planes, or of all."""
    source = model.filtered(planes, coarser)
    if part is not None:
        source, planes = cut(source, part), cut(planes, part)
    return model.decomposed_of(source, planes, grid)


def _coarse_contrasts(
    model: Model,
    schedule: Schedule,
    images: Callable[[Slices], _Pair],
    tiling: Tiling,
    step: Callable[[], None],
) -> list[Tensor]:
    """Return the weighted contrast of both images without their finest `_scales`."""
    scales = _scales(tiling)
    planes = _Joined(tiling, scales), _Joined(tiling, scales)
    for tile in tiling:
        for joined, cones in zip(planes, images(tile.around).planes, strict=True):
            joined.add(tile, bands.lowpass(cones, scales, schedule))
        step()
    return [model.filtered(joined.plane, finest=scales) for joined in planes]


def _coarse(
    model: Model,
    schedule: Schedule,
    images: Callable[[Slices], _Pair],
    tiling: Tiling,
    contrasts: list[Tensor] | None,
    step: Callable[[], None],
) -> list[Cortex]:
    """Return the levels of both images that are coarser than those of tiles."""
    octaves = tiling.levels - 1
    options = schedule, model.observer.true_means
    filtered = contrasts is not None
    # For each image: a plane of its lowpass pyramid, that of its light's, and the sum of its
    # pixels.
    planes = _Joined(tiling, octaves), _Joined(tiling, octaves)
    lights = _Joined(tiling, octaves), _Joined(tiling, octaves)
    sums = [torch.zeros(1, 1, 1, 1)] * 2
    for tile in tiling:
        around = _around(tile, tiling, contrasts)
        grid = tiling.grid_of(tile.around)
        for number, cones in enumerate(images(around.part).planes):
            source = model.filtered(cones, around.contrasts[number])
            source = source if around.inner is None else cut(source, around.inner)
            reduced = model.transform.reduced(source, octaves, *options, grid=grid)
            planes[number].add(tile, reduced)
            if filtered:
                inner = cones if around.inner is None else cut(cones, around.inner)
                reduced = model.transform.reduced(inner, octaves, *options, grid=grid)
                lights[number].add(tile, reduced)
            inside = cut(cones, around.pixels).to(widest(cones.device))
            inside = inside.sum((-2, -1), keepdim=True)
            sums[number] = sums[number].to(inside) + inside
        step()
    pixels = math.prod(tiling.size)
    coarse = []
    for joined, of_light, total in zip(planes, lights, sums, strict=True):
        plane = joined.plane
        base = Base(plane, octaves, tiling.size, (total / pixels).to(plane))
        cortex = model.transform.resume(base, *options)
        if filtered:
            base = base._replace(plane=of_light.plane)
            cortex = lowpass_of_light(cortex, base, model.observer.true_means)
        coarse.append(cortex)
    return coarse


class _Joined:
    """A plane of the image with nodes of 2^octaves pixels, that tiles are added to."""

    def __init__(self, tiling: Tiling, octaves: int) -> None:
        self._tiling = tiling
        self._node = 2**octaves
        self._plane: Tensor | None = None

    def add(self, tile: Tile, around: Tensor) -> None:
        """Add a tile from a plane (1, C, h, w) of what it is computed from."""
        # If tiles were kept until all are there, each would lie in the middle of memory that the
        # next one needs in one piece: at 16384 x 16384 that took 0.9 GB more.
        if self._plane is None:
            self._plane = self._tiling.new_plane(around, self._node)
        rows, columns = tile.of_image(self._node)
        self._plane[..., rows, columns] = cut(around, tile.within(self._node))

    @property
    def plane(self) -> Tensor:
        """The plane (1, C, h, w), once all tiles are added."""
        assert self._plane is not None
        return self._plane


def _in_squares(part: Slices, size: tuple[int, int], square: int) -> Slices:
    """Return a part extended to whole squares of so many pixels a side."""
    rows, columns = (
        slice(side.start // square * square, min(-(-side.stop // square) * square, length))
        for side, length in zip(part, size, strict=True)
    )
    return rows, columns


def _scales(tiling: Tiling) -> int:
    """Return how many scales are filtered in tiles, fewer than levels: their radius is larger."""
    return max(tiling.levels - 2, 1)


class _Around(NamedTuple):
    """What a tile is computed from."""

    part: Slices
    """What is read: the tile with its halo and, for a filtered image, what its filter needs."""
    inner: Slices | None
    """Where the tile and its halo lie in it, if they are not all of it."""
    pixels: Slices
    """Where the tile's own pixels lie in it."""
    contrasts: list[Tensor] | list[None]
    """What `_coarse_contrasts` gives there, for each image."""


def _around(tile: Tile, tiling: Tiling, contrasts: list[Tensor] | None) -> _Around:
    """Return what a tile is computed from, where ``contrasts`` are those of the whole images."""
    if contrasts is None:
        return _Around(tile.around, None, tile.within(1), [None, None])
    # A filter's samples lie on the paper's grid, wherever the nodes lie.
    scales = _scales(tiling)
    wide = tiling.wider(tile, bands.halo(scales))
    whole = Tile(wide.around, wide.around)
    coarser = [cut(contrast, whole.of_image(2**scales)) for contrast in contrasts]
    pixels = Tile(tile.part, wide.around).within(1)
    return _Around(wide.around, wide.within(1), pixels, coarser)
