"""Images that are equal in most places: the finest levels where they differ alone.

As in strips, but of tiles, and of those alone in whose surroundings the images differ: elsewhere
nothing accumulates. Tiles that lie alike on their nodes are computed as one batch.
"""

from collections.abc import Iterator
from itertools import groupby

import torch
from torch import Tensor

from torch_vdm.model.charging import AROUND
from torch_vdm.model.cortex.transform import Base, mean_of
from torch_vdm.model.distance import accumulate
from torch_vdm.model.grid import Grid
from torch_vdm.model.level import Levels
from torch_vdm.model.model import Model
from torch_vdm.precision import widest
from torch_vdm.run.schedule import Schedule
from torch_vdm.run.tiling import Tile, Tiling, cut
from torch_vdm.run.whole import differences, level_difference

# Pixels a side of a tile, levels that are computed in tiles, from the finest, and tiles in a batch.
# Status: choice, measured.
SIDE, LEVELS, TOGETHER = 128, 2, 8


def accumulated(
    model: Model, schedule: Schedule, test: Tensor, reference: Tensor, differing: Tensor, side: int
) -> Tensor:
    """Return `Model.difference` of two images (1, 3, H, W), (1, 1, h, w).

    Parameters
    ----------
    model, schedule
        What is computed, and how its steps are. Coarse differences are charged, and contrast
        sensitivity is of levels.
    test, reference
        The images.
    differing
        (rows, columns), bool: the squares of ``side`` pixels in which they differ.
    """
    size = test.shape[-2], test.shape[-1]
    transform, shifts, count = model.transform, model.transform.shifts, LEVELS + 1
    options = schedule, model.observer.true_means
    grid, levels, octaves = model.grid(size), model.levels(0, count), count - shifts
    tiling = _tiling(size, shifts, transform.reach + AROUND * shifts, grid)
    touched = [tile for tile in tiling if _touches(tile, differing, side)]

    light = model.cone_planes(reference)
    mean = mean_of(light)
    plane = transform.reduced(light, octaves, *options)
    changed, more = plane.clone(), torch.zeros_like(mean, dtype=widest(mean.device))
    fine: list[tuple[Tile, list[Tensor]]] = []
    for tiles in _alike(tiling, touched):
        first = model.cone_planes(torch.cat([cut(test, tile.around) for tile in tiles]))
        second = torch.cat([cut(light, tile.around) for tile in tiles])
        parts = _fine(model, schedule, first, second, levels, tiling.grid_of(tiles[0].around))
        for number, tile in enumerate(tiles):
            of_tile = [part[number : number + 1] for part in parts]
            within = tile.within(1)
            difference = cut(first - second, within)[number : number + 1].to(more)
            more = more + difference.sum((-2, -1), keepdim=True)
            rows, columns = tile.of_image(2**octaves)
            changed[..., rows, columns] = cut(of_tile.pop(), tile.within(2**octaves))
            fine.append((tile, of_tile))
    pixels = size[0] * size[1]
    means = mean + (more / pixels).to(mean), mean
    coarse = [
        transform.rest(Base(planes, octaves, size, of_all), *options)
        for planes, of_all in zip((changed, plane), means, strict=True)
    ]
    above = model.descended(differences(model, schedule, *coarse), coarse[0].before)
    total = above.new_zeros(1, 1, *model.leaves(size))
    for tile, parts in fine:
        places = [tile.within(2 ** (level + 1) // shifts) for level in range(LEVELS)][::-1]
        local, changes = parts[::2], parts[1::2]
        charges = model.charges(changes)
        assert charges is not None
        part = accumulate(
            list(map(cut, local, places)),
            cut(above, tile.of_image(2 ** (LEVELS + 1) // shifts)),
            before=tiling.grid_of(tile.part).down(LEVELS),
            charges=[charge.of(place) for charge, place in zip(charges, places, strict=True)],
        )
        rows, columns = tile.of_image(2 // shifts)
        total[..., rows, columns] = part
    return total


def _tiling(size: tuple[int, int], shifts: int, nodes: int, grid: Grid) -> Tiling:
    parent = 2 ** (LEVELS + 1)
    halo = -(-nodes // (2 * shifts)) * parent
    return Tiling(size, (SIDE, SIDE), LEVELS, halo, grid)


def _touches(tile: Tile, differing: Tensor, side: int) -> bool:
    """Return whether the images differ in a tile or in what it is computed from."""
    rows, columns = (slice(part.start // side, -(-part.stop // side)) for part in tile.around)
    return bool(differing[rows, columns].any())


def _alike(tiling: Tiling, tiles: list[Tile]) -> Iterator[list[Tile]]:
    """Yield tiles of one size that lie alike on their nodes, a few at a time."""

    def kind(tile: Tile) -> tuple[object, ...]:
        around = [(side.stop - side.start) for side in tile.around]
        return (*around, *tile.within(1), tiling.grid_of(tile.around))

    ordered = sorted(tiles, key=lambda tile: repr(kind(tile)))
    for _, group in groupby(ordered, key=lambda tile: repr(kind(tile))):
        some = list(group)
        for first in range(0, len(some), TOGETHER):
            yield some[first : first + TOGETHER]


def _fine(
    model: Model, schedule: Schedule, first: Tensor, second: Tensor, levels: Levels, grid: Grid
) -> list[Tensor]:
    """Return local differences and changes of the fine levels of tiles, the coarsest first.

    And last the lowpass of the first, which the coarser levels go on from.
    """
    options = schedule, model.observer.true_means
    (one, reduced), (other, _) = (
        model.transform.begin(planes, LEVELS + 1, *options, grid=grid) for planes in (first, second)
    )
    found = []
    for number in range(1, LEVELS + 1):
        level = levels.only(number)
        found.append(level_difference(model, schedule, one, other, number, level))
        found.append(model.change(one, other, number))
    return [*found, reduced]
