"""The metric of images larger than memory, one tile at a time."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.charging import AROUND, Charge
from torch_vdm.cortex import Cortex, Transform, bands
from torch_vdm.cortex.haar import lowpass_of_light
from torch_vdm.cortex.transform import Base
from torch_vdm.distance import Paths, accumulate, just_noticeable
from torch_vdm.grid import Before, Grid
from torch_vdm.images import SQUARE, masked
from torch_vdm.observer import Observer
from torch_vdm.pair import PairMetric
from torch_vdm.precision import widest
from torch_vdm.tiling import (
    TILE,
    Slices,
    Source,
    Tile,
    Tiling,
    check_sources,
    cut,
    read,
)

# Called with how many steps are done, and of how many.
Progress = Callable[[int, int], None]


class _Done(NamedTuple):
    """A tile, and what has accumulated down the paths to its leaves, (1, 1, h, w)."""

    item: int
    part: Slices
    grid: Grid
    total: Tensor
    seen: Tensor | None


class _Pair(NamedTuple):
    """The same part of a test and a reference."""

    planes: list[Tensor]
    """The cone responses to each."""
    seen: Tensor | None
    """Where both are finite, if that is asked."""


class TiledMetric(PairMetric):
    """A metric whose levels are computed in tiles or from the whole image's lowpass pyramid.

    A tile begins where a node of the coarsest level that it is cut for has its parent, and comes
    with all that its nodes, their parents and their neighbours in pooling are made of. Its levels
    are then a part of the image's, and everything else about it is cut off. The coarser levels go
    on from a plane that the tiles leave, no larger than one of them.
    """

    transform: Transform
    observer: Observer
    summation_exponent: Tensor

    def _cone_planes(self, image: Tensor) -> Tensor:
        """Return the cone responses to an image."""
        raise NotImplementedError

    def _decomposed(
        self,
        planes: Tensor,
        coarser: Tensor | None = None,
        part: Slices | None = None,
        grid: Grid | None = None,
    ) -> Cortex:
        """Return the cortex representation of cone planes; ``coarser`` as `_filtered`.

        Of a ``part`` of them, whose nodes lie as ``grid`` says, or of all.
        """
        raise NotImplementedError

    def _filtered(self, planes: Tensor, coarser: Tensor | None = None, finest: int = 0) -> Tensor:
        """Return what is decomposed of cone planes: these, or their weighted contrast.

        Where ``planes`` are part of an image, the weighted contrast that is left without its finest
        scales is given as ``coarser``, at the density that these reduce it to. ``finest``: of
        planes that `bands.lowpass` has reduced by so many scales.
        """
        raise NotImplementedError

    def _differences(self, first: Cortex, second: Cortex) -> Paths:
        """Return what the map is accumulated from."""
        raise NotImplementedError

    def _descended(self, paths: Paths, before: Sequence[Before]) -> Tensor:
        """Return what has accumulated at the leaves, (B, 1, h, w); ``before`` as `accumulate`."""
        raise NotImplementedError

    def _charges(self, changes: Sequence[Tensor]) -> list[Charge] | None:
        """Return what the nodes of each level are charged; None: all."""
        raise NotImplementedError

    @torch.no_grad()
    def tiled(
        self,
        test: Source,
        reference: Source,
        tile: int = TILE,
        out: Tensor | None = None,
        progress: Progress | None = None,
    ) -> Tensor:
        """Return the map of images that may be larger than memory: that of the whole, to rounding.

        Levels up to the size of a tile are computed tile by tile, coarser ones once, from the
        lowpass pyramid of the whole images, which is read first: so the images are read twice, and
        little more than the map and one tile is in memory. Behind a filter they are read once more,
        for what is coarser than a tile is filtered first. Without gradients.

        Parameters
        ----------
        test, reference
            (3, H, W) or (B, 3, H, W): tensors, or what is read part by part; see
            `torch_vdm.tiling.Source`. Whole numbers of 8 and 16 bits stand for 0 to 1.
        tile
            Pixels a side of a tile, 4 or more; rounded down to a multiple of what its levels need.
        out
            Where the map goes, for example a tensor over a memory-mapped file: (1, H, W) or
            (B, 1, H, W), floating point. By default a new tensor in memory.
        progress
            Called after each step with the number of steps done and of all.

        Returns
        -------
        Tensor
            ``out``, JND.

        Raises
        ------
        ValueError
            Where a parameter or an image is not as stated; ``out`` then has what was done.
        """
        items, size = check_sources(test, reference)
        shape = (*test.shape[:-3], 1, *size)
        if out is None:
            pixel = slice(0, 1), slice(0, 1)
            double = torch.float64 in {read(source, 0, pixel).dtype for source in (test, reference)}
            out = torch.empty(shape, dtype=torch.float64 if double else torch.float32)
        if tuple(out.shape) != shape or not out.is_floating_point():
            raise ValueError(
                f"expected an out of shape {shape} of floating point, "
                f"got {tuple(out.shape)}, {out.dtype}"
            )
        planes = out.view(items, *size)
        for item, part, grid, total, seen in self._in_tiles(test, reference, tile, progress):
            planes[item, part[0], part[1]] = self._jnd(total, part, grid, seen).to(out)
        return out

    @torch.no_grad()
    def tiled_score(
        self,
        test: Source,
        reference: Source,
        tile: int = TILE,
        progress: Progress | None = None,
    ) -> Tensor:
        """Return the largest value of each item's map, (B,), JND, and keep no map.

        That of the whole images, to rounding; arguments as `tiled`.
        """
        items, _ = check_sources(test, reference)
        largest: list[list[Tensor]] = [[] for _ in range(items)]
        for item, part, grid, total, seen in self._in_tiles(test, reference, tile, progress):
            largest[item].append(self._jnd(total, part, grid, seen).amax())
        return torch.stack([torch.stack(of_item).amax() for of_item in largest])

    def _jnd(self, total: Tensor, part: Slices, grid: Grid, seen: Tensor | None) -> Tensor:
        """Return the map (h, w) of a tile."""
        exponent = self._constants(total.dtype, "summation_exponent")["summation_exponent"]
        jnd = self._to_pixels(just_noticeable(total, exponent), _size(part), grid)
        return masked(jnd, seen)[0, 0]

    def _in_tiles(
        self,
        test: Source,
        reference: Source,
        side: int,
        progress: Progress | None,
    ) -> Iterator[_Done]:
        """Yield what accumulates down the paths to the leaves of every tile."""
        items, size = check_sources(test, reference)
        shifts = self.transform.shifts
        # Spatial pooling takes in fewer nodes than charging does.
        nodes = self.transform.reach + AROUND * shifts
        grid = self.transform.grid(size, self.observer.true_means)
        tiling = Tiling.fit(size, side, shifts, nodes, grid)
        filtered = self.transform.csf == "filter" and not tiling.whole
        plain = tiling.plain(bands.halo(_scales(tiling)))
        device = self.summation_exponent.device
        steps = count(1)
        passes = len(tiling) * (1 if tiling.whole else 2) + filtered * len(plain)

        def images(item: int, part: Slices) -> _Pair:
            wide = _in_squares(part, size) if self.nonfinite == "mask" else part
            one, other = (read(source, item, wide).to(device) for source in (test, reference))
            one, other, seen = self._checked(one, other, (item, wide[0].start, wide[1].start))
            if wide != part:
                inside = Tile(part, wide).within(1)
                one, other = cut(one, inside), cut(other, inside)
                seen = None if seen is None else cut(seen, inside)
            return _Pair([self._cone_planes(one), self._cone_planes(other)], seen)

        def step() -> None:
            if progress is not None:
                progress(next(steps), items * passes)

        for item in range(items):
            read_part = partial(images, item)
            contrasts: list[Tensor] | None = None
            coarse = None
            if filtered:
                contrasts = self._coarse_contrasts(read_part, plain, step)
            if not tiling.whole:
                representations = self._coarse(read_part, tiling, contrasts, step)
                before = representations[0].before
                coarse = self._descended(self._differences(*representations), before)
            for tile in tiling:
                around = _around(tile, tiling, contrasts)
                planes, seen = read_part(around.part)
                first, second = (
                    self._decomposed(cones, contrast, around.inner, tiling.grid_of(tile.around))
                    for cones, contrast in zip(planes, around.contrasts, strict=True)
                )
                paths = self._differences(first, second)
                part_grid = tiling.grid_of(tile.part)
                if coarse is None:
                    total = self._descended(paths, first.before)
                    yield _Done(item, tile.part, part_grid, total, seen)
                    step()
                    continue
                places = [
                    tile.within(2 ** (level + 1) // shifts) for level in range(tiling.levels)
                ][::-1]
                fine = slice(-tiling.levels, None)
                local = list(map(cut, paths.local[fine], places))
                charges = self._charges(paths.changes[fine])
                if charges is not None:
                    charges = [
                        Charge(
                            cut(charge.inherited, place),
                            None if charge.own is None else cut(charge.own, place),
                        )
                        for charge, place in zip(charges, places, strict=True)
                    ]
                total = cut(coarse, tile.of_image(2 ** (tiling.levels + 1) // shifts))
                seen = None if seen is None else cut(seen, around.pixels)
                before = part_grid.down(len(local))
                total = accumulate(local, total, before=before, charges=charges)
                yield _Done(item, tile.part, part_grid, total, seen)
                step()

    def _coarse_contrasts(
        self, images: Callable[[Slices], _Pair], tiling: Tiling, step: Callable[[], None]
    ) -> list[Tensor]:
        """Return the weighted contrast of both images without their `_scales`."""
        scales = _scales(tiling)
        planes: tuple[list[Tensor], list[Tensor]] = [], []
        for tile in tiling:
            for tiles, cones in zip(planes, images(tile.around).planes, strict=True):
                left = bands.lowpass(cones, scales, self._fast)
                tiles.append(cut(left, tile.within(2**scales)))
            step()
        return [self._filtered(tiling.joined(tiles), finest=scales) for tiles in planes]

    def _coarse(
        self,
        images: Callable[[Slices], _Pair],
        tiling: Tiling,
        contrasts: list[Tensor] | None,
        step: Callable[[], None],
    ) -> list[Cortex]:
        """Return the levels of both images that are coarser than those of tiles."""
        octaves = tiling.levels - 1
        options = self._fast, self.observer.true_means
        filtered = contrasts is not None
        # For each image: the tiles of its lowpass pyramid, those of its light's, and the sum of
        # its pixels.
        planes: tuple[list[Tensor], list[Tensor]] = [], []
        lights: tuple[list[Tensor], list[Tensor]] = [], []
        sums = [torch.zeros(1, 1, 1, 1)] * 2
        for tile in tiling:
            around = _around(tile, tiling, contrasts)
            grid = tiling.grid_of(tile.around)
            for number, cones in enumerate(images(around.part).planes):
                source = self._filtered(cones, around.contrasts[number])
                source = source if around.inner is None else cut(source, around.inner)
                reduced = self.transform.reduced(source, octaves, *options, grid=grid)
                planes[number].append(cut(reduced, tile.within(2**octaves)))
                if filtered:
                    inner = cones if around.inner is None else cut(cones, around.inner)
                    reduced = self.transform.reduced(inner, octaves, *options, grid=grid)
                    lights[number].append(cut(reduced, tile.within(2**octaves)))
                inside = cut(cones, around.pixels).to(widest(cones.device))
                inside = inside.sum((-2, -1), keepdim=True)
                sums[number] = sums[number].to(inside) + inside
            step()
        pixels = math.prod(tiling.size)
        coarse = []
        for tiles, of_light, total in zip(planes, lights, sums, strict=True):
            plane = tiling.joined(tiles)
            base = Base(plane, octaves, tiling.size, (total / pixels).to(plane))
            cortex = self.transform.resume(base, *options)
            if filtered:
                base = base._replace(plane=tiling.joined(of_light))
                cortex = lowpass_of_light(cortex, base, self.observer.true_means)
            coarse.append(cortex)
        return coarse


def _in_squares(part: Slices, size: tuple[int, int]) -> Slices:
    """Return a part made larger to whole squares, whose means may stand for pixels."""
    rows, columns = (
        slice(side.start // SQUARE * SQUARE, min(-(-side.stop // SQUARE) * SQUARE, length))
        for side, length in zip(part, size, strict=True)
    )
    return rows, columns


def _scales(tiling: Tiling) -> int:
    """Return how many scales are filtered in tiles: fewer than levels, for they reach further."""
    return max(tiling.levels - 2, 1)


class _Around(NamedTuple):
    """What a tile is computed from."""

    part: Slices
    """What is read: the tile with its halo, and of a filtered image with what its filter needs."""
    inner: Slices | None
    """Where in it lie the tile and its halo, if that is not all."""
    pixels: Slices
    """Where in it lie the tile's own pixels."""
    contrasts: list[Tensor] | list[None]
    """What `_coarse_contrasts` gives there, for each image."""


def _around(tile: Tile, tiling: Tiling, contrasts: list[Tensor] | None) -> _Around:
    """Return what a tile is computed from, where ``contrasts`` are those of the whole images."""
    if contrasts is None:
        return _Around(tile.around, None, tile.within(1), [None, None])
    # Wherever the nodes lie, a filter's samples lie where those of the paper's grid do.
    scales = _scales(tiling)
    wide = tiling.wider(tile, bands.halo(scales))
    whole = Tile(wide.around, wide.around)
    coarser = [cut(contrast, whole.of_image(2**scales)) for contrast in contrasts]
    pixels = Tile(tile.part, wide.around).within(1)
    return _Around(wide.around, wide.within(1), pixels, coarser)


def _size(part: Slices) -> tuple[int, int]:
    rows, columns = part
    return rows.stop - rows.start, columns.stop - columns.start
