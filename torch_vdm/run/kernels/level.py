"""A level's local visual difference by a kernel of Triton, and its gradient by two."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.cortex import Cortex
from torch_vdm.model.grid import Before
from torch_vdm.model.level import Level, Levels, sights_of
from torch_vdm.model.level import local_difference as level_difference
from torch_vdm.model.model import Model
from torch_vdm.run import kernels
from torch_vdm.run.gradients import is_plain


def is_usable(model: Model) -> bool:
    """Return whether the kernel computes a level; the model's steps do what it does not.

    That is what is traced or transformed, and constants that need a gradient or are replaced.
    """
    fixed = not any(constant.requires_grad for constant in model.constants.values())
    return fixed and model.cubes and model.grey is None and is_plain()


def local_differences(
    model: Model, first: Cortex, second: Cortex, levels: Levels
) -> tuple[Tensor, ...]:
    """Return `Model.local_differences`, one launch for each level.

    Raises
    ------
    ValueError
        If the images are where Triton cannot run.
    """
    module = kernels.of("triton_level", first.mean.device)
    numbers = module.numbers_of(levels, model.constants)
    return tuple(
        _of_level(module, model, first, second, number, numbers[number], levels.only)
        for number in range(len(first.details))
    )


def local_difference(
    model: Model, first: Cortex, second: Cortex, number: int, level: Level
) -> Tensor:
    """Return `Model.local_difference` of a level, likewise."""
    module = kernels.of("triton_level", first.mean.device)
    numbers = module.numbers_of([part.flatten().unsqueeze(0) for part in level], model.constants)
    return _of_level(module, model, first, second, number, numbers[0], lambda _: level)


def _of_level(
    module: Any,
    model: Model,
    first: Cortex,
    second: Cortex,
    number: int,
    numbers: Tensor,
    level_of: Callable[[int], Level],
) -> Tensor:
    before = first.before[number]

    def plain(details: Tensor, others: Tensor, parent: Tensor, other: Tensor) -> Tensor:
        size = details.shape[-2], details.shape[-1]
        sights = sights_of((parent, other), level_of(number), *model.sight_options())
        one, two = (sight.pushed(size, before=before) for sight in sights)
        return level_difference(details, others, one, two, model.options())

    images = (
        first.details[number],
        second.details[number],
        first.parent_lowpass(number),
        second.parent_lowpass(number),
    )
    planes = (plane.contiguous() for plane in images)
    local: Tensor = _LocalDifference.apply(plain, module, numbers, before, *planes)
    return local


class _LocalDifference(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        plain: Callable[..., Tensor],
        module: Any,
        numbers: Tensor,
        before: Before,
        *images: Tensor,
    ) -> Tensor:
        ctx.plain, ctx.module, ctx.before = plain, module, before
        ctx.save_for_backward(numbers, *images)
        local = torch.empty_like(images[0][:, :1, 0])
        nodes = local.shape[-2] * local.shape[-1]
        _launch(module.local_difference, nodes, (*images, numbers, local), images, before)
        return local

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        numbers, *images = ctx.saved_tensors
        wanted: tuple[bool, ...] = ctx.needs_input_grad[4:]
        if torch.is_grad_enabled():
            # It will be differentiated again, so this is left to autograd.
            images = [image.view_as(image) for image in images]
            inputs = [image for image, want in zip(images, wanted, strict=True) if want]
            found = torch.autograd.grad(ctx.plain(*images), inputs, gradient, create_graph=True)
            each = iter(found)
            slopes = [next(each) if want else None for want in wanted]
        else:
            slopes = _gradients(ctx.module, gradient, numbers, images, ctx.before, wanted)
        return None, None, None, None, *slopes


def _gradients(
    module: Any,
    gradient: Tensor,
    numbers: Tensor,
    images: Sequence[Tensor],
    before: Before,
    wanted: Sequence[bool],
) -> list[Tensor | None]:
    """Return the gradients by those of the ``images`` that are ``wanted``."""
    details, _, parents, _ = images
    items, *_, height, width = details.shape
    slope = details.new_empty(items, 12, height, width)
    arguments = gradient.contiguous(), *images, numbers, slope
    _launch(module.slopes, height * width, arguments, images, before)
    which = {"first": wanted[0] or wanted[2], "second": wanted[1] or wanted[3]}
    # What is not wanted is not written.
    found = [
        torch.empty_like(image) if want else image
        for image, want in zip(images, 2 * list(which.values()), strict=True)
    ]
    arguments = slope, *images, numbers, *found
    nodes = parents.shape[-2] * parents.shape[-1]
    _launch(module.gradients, nodes, arguments, images, before, **which)
    return [plane if want else None for plane, want in zip(found, wanted, strict=True)]


def _launch(
    kernel: Any,
    nodes: int,
    arguments: Sequence[Tensor],
    images: Sequence[Tensor],
    before: Before,
    **constants: bool,
) -> None:
    """Launch a kernel with a program for each block of ``nodes`` of each item."""
    sizes = *images[0].shape[-2:], *images[2].shape[-2:], *before
    kernels.launch(kernel, nodes, len(images[0]), arguments, sizes, **constants)
