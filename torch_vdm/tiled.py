"""The metric of images larger than memory, one tile at a time."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import count
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.cortex import Cortex, Transform, bands
from torch_vdm.cortex.transform import Base
from torch_vdm.distance import accumulate, just_noticeable
from torch_vdm.observer import Observer
from torch_vdm.pair import PairMetric, masked
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

# What every node of two representations adds to its paths, level 0 first, and what the paths begin
# with.
Paths = Callable[[Cortex, Cortex], tuple[Sequence[Tensor], Tensor]]


class _Done(NamedTuple):
    """A tile, and what has accumulated down the paths to its leaves, (1, 1, h, w)."""

    item: int
    part: Slices
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

    def _decomposed(self, planes: Tensor, coarser: Tensor | None = None) -> Cortex:
        """Return the cortex representation of cone planes; ``coarser`` as `_filtered`."""
        raise NotImplementedError

    def _filtered(self, planes: Tensor, coarser: Tensor | None = None, finest: int = 0) -> Tensor:
        """Return what is decomposed of cone planes: these, or their weighted contrast.

        Where ``planes`` are part of an image, the weighted contrast that is left without its finest
        scales is given as ``coarser``, at the density that these reduce it to. ``finest``: of
        planes that `bands.lowpass` has reduced by so many scales.
        """
        raise NotImplementedError

    def _differences(self, first: Cortex, second: Cortex) -> tuple[Sequence[Tensor], Tensor]:
        """Return the paths of the map."""
        raise NotImplementedError

    def _glances(self, first: Cortex, second: Cortex) -> tuple[Sequence[Tensor], Tensor]:
        """Return the paths of the detection score."""
        raise NotImplementedError

    def _detected(self, most: Tensor) -> Tensor:
        """Return the score of what the largest leaf of each item has accumulated, (B,)."""
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
        # What spatial pooling needs around a node.
        pooled = 2 * self.transform.shifts - 1
        for item, part, total, seen in self._in_tiles(
            test, reference, tile, pooled, self._differences, progress
        ):
            exponent = self.summation_exponent.to(total.dtype)
            jnd = self._to_pixels(just_noticeable(total, exponent), _size(part))
            planes[item, part[0], part[1]] = masked(jnd, seen)[0, 0].to(out)
        return out

    @torch.no_grad()
    def tiled_score(
        self,
        test: Source,
        reference: Source,
        tile: int = TILE,
        progress: Progress | None = None,
    ) -> Tensor:
        """Return the detection score (B,) of images that may be larger than memory.

        That of the whole images, to rounding; arguments as `tiled`. Halos are wider, for a glance
        takes in many nodes.
        """
        items, _ = check_sources(test, reference)
        glanced = self.transform.shifts * (self.observer.score_window + 1)
        largest: list[list[Tensor]] = [[] for _ in range(items)]
        for item, _, total, _ in self._in_tiles(
            test, reference, tile, glanced, self._glances, progress
        ):
            largest[item].append(total.amax())
        return self._detected(torch.stack([torch.stack(of_item).amax() for of_item in largest]))

    def _in_tiles(
        self,
        test: Source,
        reference: Source,
        side: int,
        nodes: int,
        paths: Paths,
        progress: Progress | None,
    ) -> Iterator[_Done]:
        """Yield what accumulates down the paths to the leaves of every tile.

        ``nodes``: how many nodes around a node ``paths`` takes in.
        """
        items, size = check_sources(test, reference)
        shifts = self.transform.shifts
        tiling = Tiling.fit(size, side, shifts, self.transform.reach + nodes)
        filtered = self.transform.csf == "filter" and not tiling.whole
        if filtered:
            tiling = tiling.wider(bands.halo(_scales(tiling)))
        device = self.summation_exponent.device
        steps = count(1)
        all_steps = items * len(tiling) * (1 if tiling.whole else 2 + filtered)

        def images(item: int, part: Slices) -> _Pair:
            one, other = (read(source, item, part).to(device) for source in (test, reference))
            one, other, seen = self._checked(one, other, (item, part[0].start, part[1].start))
            return _Pair([self._cone_planes(one), self._cone_planes(other)], seen)

        def step() -> None:
            if progress is not None:
                progress(next(steps), all_steps)

        for item in range(items):
            read_part = partial(images, item)
            contrasts: list[Tensor] | None = None
            coarse = None
            if filtered:
                contrasts = self._coarse_contrasts(read_part, tiling, step)
            if not tiling.whole:
                representations = self._coarse(read_part, tiling, contrasts, step)
                coarse = accumulate(*paths(*representations))
            for tile in tiling:
                planes, seen = read_part(tile.around)
                around = _around(tile, tiling, contrasts)
                first, second = map(self._decomposed, planes, around)
                local, total = paths(first, second)
                if coarse is not None:
                    fine = enumerate(reversed(local[-tiling.levels :]))
                    local = [cut(plane, tile.within(2 ** (k + 1) // shifts)) for k, plane in fine]
                    local.reverse()
                    total = cut(coarse, tile.of_image(2 ** (tiling.levels + 1) // shifts))
                    seen = None if seen is None else cut(seen, tile.within(1))
                yield _Done(item, tile.part, accumulate(local, total), seen)
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
        # For each image: the tiles of its lowpass pyramid, and the sum of its pixels.
        planes: tuple[list[Tensor], list[Tensor]] = [], []
        sums = [torch.zeros(1, 1, 1, 1, dtype=torch.float64)] * 2
        for tile in tiling:
            around = _around(tile, tiling, contrasts)
            for number, cones in enumerate(images(tile.around).planes):
                source = self._filtered(cones, around[number])
                reduced = self.transform.reduced(source, octaves, *options)
                planes[number].append(cut(reduced, tile.within(2**octaves)))
                inside = cut(cones, tile.within(1)).double().sum((-2, -1), keepdim=True)
                sums[number] = sums[number].to(inside) + inside
            step()
        pixels = math.prod(tiling.size)
        coarse = []
        for tiles, total in zip(planes, sums, strict=True):
            plane = tiling.joined(tiles)
            base = Base(plane, octaves, tiling.size, (total / pixels).to(plane))
            coarse.append(self.transform.resume(base, *options))
        return coarse


def _scales(tiling: Tiling) -> int:
    """Return how many scales are filtered in tiles: fewer than levels, for they reach further."""
    return max(tiling.levels - 2, 1)


def _around(
    tile: Tile, tiling: Tiling, contrasts: list[Tensor] | None
) -> list[Tensor] | list[None]:
    """Return what `_coarse_contrasts` gives around a tile, for each image."""
    if contrasts is None:
        return [None, None]
    whole = Tile(tile.around, tile.around)
    return [cut(contrast, whole.of_image(2 ** _scales(tiling))) for contrast in contrasts]


def _size(part: Slices) -> tuple[int, int]:
    rows, columns = part
    return rows.stop - rows.start, columns.stop - columns.start
