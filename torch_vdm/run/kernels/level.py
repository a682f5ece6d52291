"""Levels' local visual differences by one kernel of Triton, and their gradients by two."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.cortex import Cortex
from torch_vdm.model.level import Level, Levels, sights_of
from torch_vdm.model.level import local_difference as level_difference
from torch_vdm.model.model import Model
from torch_vdm.run import kernels
from torch_vdm.run.column import apart, joined
from torch_vdm.run.kernels.table import Table, table_of


def is_usable(model: Model) -> bool:
    """Return whether the kernel computes a level; the model's steps do what it does not.

    That is constants that need a gradient or are replaced, and grey images as one plane.
    """
    fixed = not any(constant.requires_grad for constant in model.constants.values())
    return fixed and model.cubes and model.grey is None


def local_differences(
    model: Model, first: Cortex, second: Cortex, levels: Levels
) -> tuple[Tensor, ...]:
    """Return `Model.local_differences`, in one launch.

    Raises
    ------
    ValueError
        If the images are where Triton cannot run.
    """
    numbers = range(len(first.details))
    return _of_levels(model, first, second, numbers, levels, levels.only)


def local_difference(
    model: Model, first: Cortex, second: Cortex, number: int, level: Level
) -> Tensor:
    """Return `Model.local_difference` of a level, likewise."""
    parts = [part.flatten().unsqueeze(0) for part in level]
    (local,) = _of_levels(model, first, second, [number], parts, lambda _: level)
    return local


def _of_levels(
    model: Model,
    first: Cortex,
    second: Cortex,
    numbers: Sequence[int],
    parts: Sequence[Tensor],
    level_of: Callable[[int], Level],
) -> tuple[Tensor, ...]:
    """Return the local visual differences of the levels of these ``numbers``.

    ``parts`` are those of their `Levels`; ``level_of`` returns those of one number.
    """
    if not numbers:
        return ()
    module = kernels.of("triton_level", first.mean)
    before = [first.before[number] for number in numbers]
    details = [[cortex.details[number] for number in numbers] for cortex in (first, second)]
    parents = [[cortex.parent_lowpass(number) for number in numbers] for cortex in (first, second)]
    sizes, above = (tuple(map(_size, planes)) for planes in (details[0], parents[0]))
    table = table_of(sizes, above, before, first.mean)

    def plain(*columns: Tensor) -> Tensor:
        of_sizes = zip(columns, (sizes, sizes, above, above), strict=True)
        planes = zip(numbers, before, *(apart(*each) for each in of_sizes), strict=True)
        local = []
        for number, put_before, details, others, parent, other in planes:
            sights = sights_of((parent, other), level_of(number), *model.sight_options())
            one, two = (sight.pushed(_size(details), put_before) for sight in sights)
            local.append(level_difference(details, others, one, two, model.options()))
        return joined(local)

    of_levels = module.numbers_of(parts, model.constants)
    # One image may be compared with many.
    items = max(len(first.mean), len(second.mean))
    columns = map(joined, (*details, *parents))
    images = (each.expand(items, *each.shape[1:]).contiguous() for each in columns)
    local: Tensor = _LocalDifference.apply(plain, module, of_levels, table, *images)
    return tuple(apart(local, sizes))


class _LocalDifference(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        plain: Callable[..., Tensor],
        module: Any,
        numbers: Tensor,
        table: Table,
        *images: Tensor,
    ) -> Tensor:
        ctx.plain, ctx.module, ctx.table = plain, module, table
        ctx.save_for_backward(numbers, *images)
        local = torch.empty_like(images[0][:, :1, 0])
        planes = *images, numbers, table.rows, local
        _launch(module.local_difference, table.programs, planes, table)
        return local

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        numbers, *images = ctx.saved_tensors
        wanted: tuple[bool, ...] = ctx.needs_input_grad[4:]
        if torch.is_grad_enabled():
            slopes = kernels.differentiated(ctx.plain, images, wanted, gradient)
        else:
            slopes = _gradients(ctx.module, gradient, numbers, images, ctx.table, wanted)
        return None, None, None, None, *slopes


def _gradients(
    module: Any,
    gradient: Tensor,
    numbers: Tensor,
    images: Sequence[Tensor],
    table: Table,
    wanted: Sequence[bool],
) -> list[Tensor | None]:
    """Return the gradients by those of the ``images`` that are ``wanted``."""
    slope = gradient.new_empty(len(gradient), 12, table.nodes)
    planes = gradient.contiguous(), *images, numbers, table.rows, slope
    _launch(module.slopes, table.programs, planes, table)
    which = {"first": wanted[0] or wanted[2], "second": wanted[1] or wanted[3]}
    # What is not wanted is not written.
    found = [
        torch.empty_like(image) if want else image
        for image, want in zip(images, 2 * list(which.values()), strict=True)
    ]
    planes = slope, *images, numbers, table.rows, *found
    _launch(module.gradients, table.programs_of_parents, planes, table, **which)
    return [plane if want else None for plane, want in zip(found, wanted, strict=True)]


def _launch(
    kernel: Any,
    programs: int,
    planes: Sequence[Tensor],
    table: Table,
    **constants: bool,
) -> None:
    """Launch a kernel for the levels of all items."""
    sizes = len(table.sizes), table.nodes, table.parents
    kernels.launch(kernel, programs, len(planes[0]), planes, sizes, **constants)


def _size(plane: Tensor) -> tuple[int, int]:
    return plane.shape[-2], plane.shape[-1]
