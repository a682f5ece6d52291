"""Whole planes, level by level; the coarsest levels at once, with their nodes in a column."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torch_vdm.model.charging import AROUND, Charge, changes, charge_within
from torch_vdm.model.cortex import Cortex, Haar
from torch_vdm.model.distance import Paths, accumulate, passed_down
from torch_vdm.model.grid import Before
from torch_vdm.model.level import (
    Level,
    Levels,
    Sight,
    local_difference,
    pooled_difference,
    pushed,
    response_difference,
    response_difference_at,
    summed_across,
)
from torch_vdm.model.model import Model, weights_alone
from torch_vdm.run import schedule as limits
from torch_vdm.run.column import Cells, Column, cells_of, column_of, joined
from torch_vdm.run.gradients import by_hand
from torch_vdm.run.gradients.level import local_difference_by_hand
from torch_vdm.run.kernels import descent as kernel_of_descent
from torch_vdm.run.kernels import level as kernel_of_levels
from torch_vdm.run.schedule import Schedule


def accumulated(model: Model, schedule: Schedule, test: Tensor, reference: Tensor) -> Tensor:
    """Return `Model.difference` of two images, (B, 1, h, w)."""
    if not schedule.together or model.transform.csf != "levels":
        first, second = model.represent(test), model.represent(reference)
        return compared(model, schedule, first, second)
    planes = torch.cat([model.cone_planes(image) for image in (test, reference)])
    return compared(model, schedule, *_halves(model.decomposed(planes)))


def compared(model: Model, schedule: Schedule, first: Cortex, second: Cortex) -> Tensor:
    """Return the accumulated differences (B, 1, h, w) of two representations."""
    return descended(model, schedule, differences(model, schedule, first, second), first.before)


def descended(model: Model, schedule: Schedule, paths: Paths, before: Sequence[Before]) -> Tensor:
    """Return `Model.descended`, computing what the coarsest levels are charged at once."""
    if schedule.by_kernel and model.observer.charging and paths.local:
        _, charge = _column_charge(model, schedule, paths.changes, before)
        return kernel_of_descent.accumulated(paths, charge, before)
    charges = _charges(model, schedule, paths.changes, before) if model.observer.charging else None
    down = schedule.form(passed_down, paths.root)
    return accumulate(paths.local, paths.root, before, charges, down)


def differences(model: Model, schedule: Schedule, first: Cortex, second: Cortex) -> Paths:
    """Return what the map is accumulated from."""
    local = local_differences(model, schedule, first, second)
    return Paths(local, _changes(model, schedule, first, second), model.root(first, second))


def local_differences(
    model: Model, schedule: Schedule, first: Cortex, second: Cortex
) -> tuple[Tensor, ...]:
    """Return `Model.local_differences`, dropping the responses of a level once they are used."""
    levels = model.levels(first.finest, len(first.details))
    if schedule.by_kernel and kernel_of_levels.is_usable(model):
        return kernel_of_levels.local_differences(model, first, second, levels)
    few = _few(schedule, first.details)
    return (
        *_of_few(model, schedule, first, second, few, levels),
        *(
            level_difference(model, schedule, first, second, number, levels.only(number))
            for number in range(few, len(first.details))
        ),
    )


def level_difference(
    model: Model, schedule: Schedule, first: Cortex, second: Cortex, number: int, level: Level
) -> Tensor:
    """Return `Model.local_difference` of a level."""
    if schedule.by_kernel and kernel_of_levels.is_usable(model):
        return kernel_of_levels.local_difference(model, first, second, number, level)
    details, others = first.details[number], second.details[number]
    options = model.options()
    sights = model.sights(level, (first, second), number)
    sight, other_sight = pushed(sights, _size(details), first.before[number])
    # One orientation at a time where the planes are large and no orientation masks another:
    # intermediate results then stay in the cache. Compiled code keeps none.
    at_once = orientations = details.shape[2]
    if not (options.signed and options.masking):
        large = schedule.rows(orientations, details.numel(), limits.LARGEST_AT_ONCE) < orientations
        at_once = options.phases if large else orientations

    def of(one: Tensor, other: Tensor, sight: Sight, other_sight: Sight) -> Tensor:
        return local_difference(one, other, sight, other_sight, options, schedule)

    # Where the gradient is worked out by hand, nothing needs to be kept.
    fixed = options.matrix, options.transducer_exponent, options.summation_exponent
    known = (
        by_hand()
        and options.signed
        and options.masking
        and options.pooled > 1
        and model.transform == Haar()
        and not schedule.compiled
        and not any(constant.requires_grad for constant in fixed)
    )
    local = []
    # A plane that is not cut is passed itself: compiled code is specialised on views.
    parts, other_parts = (
        (plane,) if at_once == orientations else plane.split(at_once, 2)
        for plane in (details, others)
    )
    for cut, (one, other) in enumerate(zip(parts, other_parts, strict=True)):
        some = slice(cut * at_once, (cut + 1) * at_once)
        arguments = one, other, sight.of(some), other_sight.of(some)
        if known:
            local.append(local_difference_by_hand(of, *arguments, *fixed, options.cubes))
        else:
            local.append(schedule.part(of, *arguments))
    return torch.stack(local).sum(0) if len(local) > 1 else local[0]


def _of_few(
    model: Model, schedule: Schedule, first: Cortex, second: Cortex, few: int, levels: Levels
) -> list[Tensor]:
    """Return the local visual differences of the ``few`` coarsest levels, in a column."""
    if few == 0:
        return []
    options = model.options()
    column = _column(first.details[:few], first.before, first.windows or first.lowpass)
    details = [joined(cortex.details[:few]) for cortex in (first, second)]
    level = levels.in_a_column(column.level)
    difference = _column_difference(model, schedule, (first, second), column, details, level)
    cells = cells_of(column.sizes, options.ring, difference)
    around = summed_across(cells.of(difference), options, schedule)
    return column.planes(cells.column(schedule.valid(pooled_difference, around, options)))


def _column_difference(
    model: Model,
    schedule: Schedule,
    images: Sequence[Cortex],
    column: Column,
    details: Sequence[Tensor],
    level: Level,
) -> Tensor:
    """Return the `difference_of` two images' responses at the nodes in a column."""
    options = model.options()
    if model.transform.csf == "filter":
        sight = weights_alone(level)
        return response_difference(details[0], details[1], sight, sight, options)
    # All but the finest of these levels have the parents of others.
    most = max(len(column.sizes) - 1, 1)
    above = [(cortex.windows or cortex.lowpass)[:most] for cortex in images]
    # Images that are compared at the same light share it, and what follows from it.
    one = all(plane is other for plane, other in zip(*above, strict=True))
    parents = [column.of_parents(joined(planes)) for planes in above[: 1 if one else 2]]
    seen_at = parents, level, *model.sight_options()
    difference: Tensor = schedule(response_difference_at, *details, seen_at, options)
    return difference


def _column(
    planes: Sequence[Tensor], before: Sequence[Before], parents: Sequence[Tensor] = ()
) -> Column:
    """Return the column of the levels that planes (..., h, w) belong to, the coarsest first.

    ``parents``: the planes that hold the parents of their nodes.
    """
    sizes, above = (tuple(map(_size, each)) for each in (planes, parents[: len(planes)]))
    return column_of(sizes, before[: len(planes)], planes[0], above)


def _charges(
    model: Model, schedule: Schedule, changes: Sequence[Tensor], before: Sequence[Before]
) -> list[Charge]:
    """Return `Model.charges`, of the coarsest levels at once."""
    few = _few(schedule, changes)
    coarse: list[Charge] = []
    if few:
        column, (inherited, own) = _column_charge(model, schedule, changes[:few], before)
        owns = [None] * few if own is None else column.planes(own)
        coarse = list(map(Charge, column.planes(inherited), owns))
    return coarse + (model.charges(changes[few:]) or [])


def _column_charge(
    model: Model, schedule: Schedule, changes: Sequence[Tensor], before: Sequence[Before]
) -> tuple[Column, Charge]:
    """Return `Model.charges` of levels, the coarsest first, in columns."""
    column = _column(changes, before)
    shifts, filtered = model.transform.shifts, model.transform.csf == "filter"
    cells = cells_of(column.sizes, (AROUND * shifts, AROUND * shifts), changes[0])
    options = shifts, filtered, schedule.cached
    charge: Charge = schedule.once(_charge_within, joined(changes), cells, *options)
    return column, charge


def _charge_within(
    column: Tensor, cells: Cells, shifts: int, filtered: bool, cached: bool
) -> Charge:
    """Return `charge_within` of levels in a column, in columns."""
    inherited, own = charge_within(cells.of(column), shifts, filtered, cached)
    return Charge(cells.column(inherited), None if own is None else cells.column(own))


def _changes(model: Model, schedule: Schedule, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
    """Return `Model.changes`, computing those of the coarsest levels at once."""
    if not model.observer.charging:
        return ()
    few = 0 if model.quartered else _few(schedule, first.details)
    coarse: list[Tensor] = []
    if few:
        column = _column(first.lowpass[:few], first.before)
        lowpass = (joined(cortex.lowpass[:few]) for cortex in (first, second))
        coarse = column.planes(schedule.once(changes, *lowpass))
    fine = range(few, len(first.details))
    return (*coarse, *(model.change(first, second, number) for number in fine))


def _halves(both: Cortex) -> Iterator[Cortex]:
    """Yield the representations of the first and of the second half of a batch."""
    for half in (0, 1):
        yield both.each(lambda plane, half=half: plane.chunk(2)[half])


def _few(schedule: Schedule, planes: Sequence[Tensor]) -> int:
    """Return how many levels, from the coarsest, are computed at once."""
    return sum(plane.shape[-2] * plane.shape[-1] <= schedule.few for plane in planes)


def _size(plane: Tensor) -> tuple[int, int]:
    return plane.shape[-2], plane.shape[-1]
