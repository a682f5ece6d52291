"""Images that are equal in most places: the finest levels are computed only where they differ.

This works as in strips, but with rectangles that together cover all places near a difference:
elsewhere nothing accumulates.
"""

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.charging import AROUND
from torch_vdm.model.cortex.transform import Base, mean_of
from torch_vdm.model.grid import Grid
from torch_vdm.model.level import Levels
from torch_vdm.model.model import Model
from torch_vdm.precision import widest
from torch_vdm.run.schedule import Schedule
from torch_vdm.run.tiles import within_tile
from torch_vdm.run.tiling import Slices, Tile, Tiling, cut
from torch_vdm.run.whole import compared, level_difference

# Levels that are computed in rectangles, from the finest. Status: choice, measured.
LEVELS = 2

# A rectangle is cut in two if less than this fraction of it is near a difference, down to so many
# squares a side. Status: choice, measured.
FULL, SMALLEST = 0.5, 8


def accumulated(
    model: Model, schedule: Schedule, test: Tensor, reference: Tensor, differing: Tensor, side: int
) -> Tensor:
    """Return `Model.difference` of two images (1, 3, H, W), (1, 1, h, w).

    Parameters
    ----------
    model, schedule
        What is computed, and how. Coarse differences must be charged, and contrast sensitivity
        must act on levels.
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
    # Beyond the radius of pooling, filters and parent, no level has or inherits a difference.
    reach = -(-(transform.reach + 2 * shifts) // shifts) * 2**LEVELS
    near = -(-reach // side)
    touched = [_tile(box, side, tiling) for box in rectangles(_grown(differing, near))]

    light = model.cone_planes(reference)
    mean = mean_of(light)
    plane = transform.reduced(light, octaves, *options)
    changed, more = plane.clone(), torch.zeros_like(mean, dtype=widest(mean.device))
    fine: list[tuple[Tile, list[Tensor]]] = []
    for tile in touched:
        first, second = model.cone_planes(cut(test, tile.around)), cut(light, tile.around)
        parts = _fine(model, schedule, first, second, levels, tiling.grid_of(tile.around))
        difference = cut(first - second, tile.within(1)).to(more)
        more = more + difference.sum((-2, -1), keepdim=True)
        rows, columns = tile.of_image(2**octaves)
        changed[..., rows, columns] = cut(parts.pop(), tile.within(2**octaves))
        fine.append((tile, parts))
    pixels = size[0] * size[1]
    means = mean + (more / pixels).to(mean), mean
    coarse = [
        transform.rest(Base(planes, octaves, size, of_all), *options)
        for planes, of_all in zip((changed, plane), means, strict=True)
    ]
    above = compared(model, schedule, *coarse)
    total = above.new_zeros(1, 1, *model.leaves(size))
    for tile, parts in fine:
        part = within_tile(model, tiling, tile, parts[::2], parts[1::2], above)
        rows, columns = tile.of_image(2 // shifts)
        total[..., rows, columns] = part
    return total


def _tiling(size: tuple[int, int], shifts: int, nodes: int, grid: Grid) -> Tiling:
    parent = 2 ** (LEVELS + 1)
    halo = -(-nodes // (2 * shifts)) * parent
    # It is cut by rectangles, and so never whole.
    return Tiling(size, (0, 0), LEVELS, halo, grid)


def _grown(differing: Tensor, by: int) -> Tensor:
    """Return the squares, grown by so many squares on every side."""
    some = differing[None, None].float()
    return functional.max_pool2d(some, 2 * by + 1, 1, by)[0, 0] > 0.0


def rectangles(squares: Tensor) -> list[Slices]:
    """Return disjoint rectangles that cover all squares set in a plane (rows, columns)."""
    left, found = [(slice(0, squares.shape[0]), slice(0, squares.shape[1]))], []
    some = squares.cpu()
    while left:
        box = left.pop()
        inside = some[box]
        places = [inside.any(1).nonzero().flatten(), inside.any(0).nonzero().flatten()]
        if len(places[0]) == 0:
            continue
        rows, columns = (
            slice(side.start + int(place[0]), side.start + int(place[-1]) + 1)
            for side, place in zip(box, places, strict=True)
        )
        sides = rows.stop - rows.start, columns.stop - columns.start
        full = float(some[rows, columns].float().mean()) >= FULL
        if full or max(sides) <= SMALLEST:
            found.append((rows, columns))
        elif sides[0] >= sides[1]:
            middle = rows.start + sides[0] // 2
            left += [(slice(rows.start, middle), columns), (slice(middle, rows.stop), columns)]
        else:
            middle = columns.start + sides[1] // 2
            left += [(rows, slice(columns.start, middle)), (rows, slice(middle, columns.stop))]
    return found


def _tile(box: Slices, side: int, tiling: Tiling) -> Tile:
    """Return a rectangle of squares as a tile, which begins and ends where parents do."""
    parent = 2 ** (LEVELS + 1)
    offsets = tiling.grid.offset(LEVELS + 1)

    def snapped(part: slice, more: int, offset: int, length: int) -> slice:
        first = (side * part.start - more + offset) // parent * parent - offset
        last = -(-(side * part.stop + more + offset) // parent) * parent - offset
        return slice(max(first, 0), min(last, length))

    part, around = (
        tuple(map(snapped, box, (more, more), offsets, tiling.size)) for more in (0, tiling.halo)
    )
    return Tile((part[0], part[1]), (around[0], around[1]), tiling.grid)


def _fine(
    model: Model, schedule: Schedule, first: Tensor, second: Tensor, levels: Levels, grid: Grid
) -> list[Tensor]:
    """Return local differences and changes of the fine levels of tiles, the coarsest first.

    The last entry is the lowpass of the first image, from which the coarser levels continue.
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
