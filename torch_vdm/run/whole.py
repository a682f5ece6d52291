"""Whole planes, level by level; the coarsest levels at once, with their nodes in a row."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.charging import changes
from torch_vdm.model.cortex import Cortex, Haar
from torch_vdm.model.distance import Paths
from torch_vdm.model.level import (
    Level,
    Levels,
    Sight,
    local_difference,
    pooled_difference,
    response_difference,
    response_difference_at,
    surrounded,
)
from torch_vdm.model.model import Model, weights_alone
from torch_vdm.model.pooling import within
from torch_vdm.model.quadtree import apart, push, stacked
from torch_vdm.run import kernel
from torch_vdm.run import schedule as limits
from torch_vdm.run.backward import by_hand, local_difference_by_hand
from torch_vdm.run.schedule import Schedule


def accumulated(model: Model, schedule: Schedule, test: Tensor, reference: Tensor) -> Tensor:
    """Return `Model.difference` of two images, (B, 1, h, w)."""
    if schedule.together and model.transform.csf == "levels":
        planes = torch.cat([model.cone_planes(image) for image in (test, reference)])
        return compared(model, schedule, *_halves(model.decomposed(planes)))
    if not schedule.stacked:
        first, second = model.represent(test), model.represent(reference)
        return compared(model, schedule, first, second)
    # Stacked vertically: compiled code for one image serves a batch.
    options, items = (schedule, model.observer.true_means), len(test)
    first, second = (
        Haar().decompose(model.cone_planes(stacked(image)), *options, items)
        for image in (test, reference)
    )
    return apart(compared(model, schedule, first, second)[0], items).transpose(0, 1)


def compared(model: Model, schedule: Schedule, first: Cortex, second: Cortex) -> Tensor:
    """Return the accumulated differences (B, 1, h, w) of two representations."""
    paths = differences(model, schedule, first, second)
    return model.descended(paths, first.before, first.items)


def differences(model: Model, schedule: Schedule, first: Cortex, second: Cortex) -> Paths:
    """Return what the map is accumulated from."""
    local = local_differences(model, schedule, first, second)
    return Paths(local, _changes(model, schedule, first, second), model.root(first, second))


def local_differences(
    model: Model, schedule: Schedule, first: Cortex, second: Cortex
) -> tuple[Tensor, ...]:
    """Return `Model.local_differences`, dropping the responses of a level once they are used."""
    levels = model.levels(first.finest, len(first.details))
    if schedule.kernel and kernel.is_usable(model):
        return kernel.local_differences(model, first, second, levels)
    few = _few(schedule, first)
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
    if schedule.kernel and kernel.is_usable(model):
        return kernel.local_difference(model, first, second, number, level)
    details, others = first.details[number], second.details[number]
    items, options = first.items, model.options()
    sight, other_sight = (
        sight.pushed(_size(details), items, first.before[number])
        for sight in model.sights(level, (first, second), number)
    )
    # One orientation at a time where the planes are large and no orientation masks another:
    # intermediate results then stay in the cache. Compiled code keeps none.
    at_once = orientations = details.shape[2]
    if not (options.signed and options.masking):
        large = schedule.rows(orientations, details.numel(), limits.LARGEST_AT_ONCE) < orientations
        at_once = options.phases if large else orientations

    def of(one: Tensor, other: Tensor, sight: Sight, other_sight: Sight) -> Tensor:
        return local_difference(one, other, sight, other_sight, options, schedule, items)

    # Where the gradient is worked out by hand, nothing needs to be kept.
    fixed = options.matrix, options.transducer_exponent, options.summation_exponent
    known = (
        by_hand()
        and options.signed
        and options.masking
        and options.pooled > 1
        and model.transform == Haar()
        and not schedule.compiled
        and items == 1
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
            local.append(local_difference_by_hand(of, *arguments, *fixed))
        else:
            local.append(schedule.part(of, *arguments))
    return torch.stack(local).sum(0) if len(local) > 1 else local[0]


def _of_few(
    model: Model, schedule: Schedule, first: Cortex, second: Cortex, few: int, levels: Levels
) -> list[Tensor]:
    """Return the local visual differences of the ``few`` coarsest levels, with nodes in a row."""
    if few == 0:
        return []
    items, options = first.items, model.options()
    sizes = [_size(detail) for detail in first.details[:few]]
    nodes = [math.prod(size) for size in sizes]
    details = _in_a_row(first.details[:few]), _in_a_row(second.details[:few])
    level = levels.in_a_row(nodes)
    if model.transform.csf == "filter":
        sight = weights_alone(level)
        difference = response_difference(details[0], details[1], sight, sight, options)
    else:
        # Both images in one batch: nothing is computed here.
        images = first, second
        parents = _in_a_row(
            push(
                torch.cat([cortex.parent_lowpass(number) for cortex in images]),
                size,
                items,
                first.before[number],
            )
            for number, size in enumerate(sizes)
        )
        both = [parent.clone() for parent in parents.chunk(2)]
        seen_at = (both, level, *model.sight_options())
        difference = schedule(response_difference_at, *details, seen_at, options)
    around = [surrounded(plane, options, items=items) for plane in _planes(difference, sizes)]
    # Side by side along the longer axis, which needs the least padding.
    along = -1 if sizes[-1][0] <= sizes[-1][1] else -2
    gathered: Tensor = schedule(pooled_difference, _joined(around, along), options)
    starts = itertools.accumulate((plane.shape[along] for plane in around), initial=0)
    local = []
    for start, plane, (rows, columns) in zip(starts, around, sizes, strict=False):
        # The padding around the items is still between them.
        long = rows + (items - 1) * (plane.shape[-1] - columns)
        part = gathered.narrow(along, start, (long, columns)[along])[..., :long, :columns]
        local.append(within(part, rows, items))
    return local


def _changes(model: Model, schedule: Schedule, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
    """Return `Model.changes`, computing those of the coarsest levels at once."""
    if not model.observer.charging:
        return ()
    few = 0 if model.quartered else _few(schedule, first)
    coarse: list[Tensor] = []
    if few:
        rows = changes(*(_in_a_row(cortex.lowpass[:few]) for cortex in (first, second)))
        coarse = _planes(rows, [_size(detail) for detail in first.details[:few]])
    fine = range(few, len(first.details))
    return (*coarse, *(model.change(first, second, number) for number in fine))


def _halves(both: Cortex) -> Iterator[Cortex]:
    """Yield the representations of the first and of the second half of a batch."""
    for half in (0, 1):
        yield both.each(lambda plane, half=half: plane.chunk(2)[half])


def _few(schedule: Schedule, cortex: Cortex) -> int:
    """Return how many levels, from the coarsest, are computed at once."""
    return sum(math.prod(_size(detail)) <= schedule.few for detail in cortex.details)


def _size(plane: Tensor) -> tuple[int, int]:
    return plane.shape[-2], plane.shape[-1]


def _in_a_row(planes: Iterable[Tensor]) -> Tensor:
    """Return the nodes of planes (..., h, w) in a row, (..., 1, all of them)."""
    return torch.cat([plane.flatten(-2).unsqueeze(-2) for plane in planes], -1)


def _planes(row: Tensor, sizes: Sequence[tuple[int, int]]) -> list[Tensor]:
    """Return the planes (..., h, w) of nodes in a row, (..., 1, all of them)."""
    parts = row.squeeze(-2).split([math.prod(size) for size in sizes], -1)
    return [part.unflatten(-1, size) for part, size in zip(parts, sizes, strict=True)]


def _joined(planes: Sequence[Tensor], along: int) -> Tensor:
    """Return planes (..., h, w) joined into one along the last or the last but one dimension.

    The other dimension is that of the longest; shorter ones are padded with zeros.
    """
    lengths = [plane.shape[-3 - along] for plane in planes]
    padded = []
    for plane, length in zip(planes, lengths, strict=True):
        rest = max(lengths) - length
        sides = (0, 0, 0, rest) if along == -1 else (0, rest)
        padded.append(functional.pad(plane, sides) if rest else plane)
    return torch.cat(padded, along)
