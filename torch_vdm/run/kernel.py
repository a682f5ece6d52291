"""A level's local visual difference by kernels of Triton, forward and backward, for GPUs.

A level is one launch, and two for its gradient, where the model's steps are many operations, each
of which a GPU waits for. The kernels are in `torch_vdm.run.triton_level`. On a processor only
Triton's interpreter runs them, for tests: it does so where TRITON_INTERPRET=1 was set before they
are first used.
"""

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from torch_vdm.effects import Effects
from torch_vdm.model.cortex import Cortex, Haar, Transform
from torch_vdm.model.grid import Before
from torch_vdm.model.level import Level, Levels, sights_of
from torch_vdm.model.level import local_difference as level_difference
from torch_vdm.model.model import Model
from torch_vdm.observer import Observer
from torch_vdm.run.backward import is_plain
from torch_vdm.run.schedule import Schedule

# Nodes, or parents, of a program. Status: choice, not measured.
BLOCK = 128

# The summation exponent that the kernels are written for: that of the calibrated observer.
EXPONENT = 6.0


def require(schedule: Schedule, observer: Observer, transform: Transform, effects: Effects) -> None:
    """Raise ValueError where there is no kernel for these options, or no Triton."""
    known = (
        observer.signed
        and observer.adaptation_luminance is None
        and observer.summation_exponent == EXPONENT
    )
    for right, what in (
        (known, f'with the observer "{observer.name}"; it is of the calibrated one'),
        (transform == Haar(), f"with {transform}; it is of Haar() alone"),
        (effects == Effects(), "with effects left out; it has all of them"),
        (not schedule.stacked, "that is stacked as well; it takes batches as they are"),
    ):
        if not right:
            raise ValueError(f"expected a schedule without the kernel, got one {what}")
    if find_spec("triton") is None:
        raise ValueError(
            "expected Triton for a schedule with the kernel, got none: pip install triton"
        )


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
    kernels = kernels_on(first.mean.device)
    numbers = kernels.numbers_of(levels, model.constants)
    return tuple(
        _of_level(kernels, model, first, second, number, numbers[number], levels.only)
        for number in range(len(first.details))
    )


def local_difference(
    model: Model, first: Cortex, second: Cortex, number: int, level: Level
) -> Tensor:
    """Return `Model.local_difference` of a level, likewise."""
    kernels = kernels_on(first.mean.device)
    numbers = kernels.numbers_of([part.flatten().unsqueeze(0) for part in level], model.constants)
    return _of_level(kernels, model, first, second, number, numbers[0], lambda _: level)


def _of_level(
    kernels: Any,
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
    local: Tensor = _LocalDifference.apply(plain, kernels, numbers, before, *planes)
    return local


def kernels_on(device: torch.device) -> Any:
    """Return the module of the kernels; raise ValueError if they cannot run on a device."""
    from torch_vdm.run import triton_level

    if device.type == "meta" or (device.type == "cpu" and not triton_level.INTERPRETED):
        raise ValueError(
            f"expected images on a GPU for a schedule with the kernel, got them on {device}; leave "
            "the kernel out, or set TRITON_INTERPRET=1 to try it slowly"
        )
    return triton_level


class _LocalDifference(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        plain: Callable[..., Tensor],
        kernels: Any,
        numbers: Tensor,
        before: Before,
        *images: Tensor,
    ) -> Tensor:
        ctx.plain, ctx.kernels, ctx.before = plain, kernels, before
        ctx.save_for_backward(numbers, *images)
        local = torch.empty_like(images[0][:, :1, 0])
        nodes = local.shape[-2] * local.shape[-1]
        _launch(kernels.local_difference, nodes, (*images, numbers, local), images, before)
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
            slopes = _gradients(ctx.kernels, gradient, numbers, images, ctx.before, wanted)
        return None, None, None, None, *slopes


def _gradients(
    kernels: Any,
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
    _launch(kernels.slopes, height * width, arguments, images, before)
    which = {"first": wanted[0] or wanted[2], "second": wanted[1] or wanted[3]}
    # What is not wanted is not written.
    found = [
        torch.empty_like(image) if want else image
        for image, want in zip(images, 2 * list(which.values()), strict=True)
    ]
    arguments = slope, *images, numbers, *found
    nodes = parents.shape[-2] * parents.shape[-1]
    _launch(kernels.gradients, nodes, arguments, images, before, **which)
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
    grid = -(-nodes // BLOCK), len(images[0])
    with torch.cuda.device_of(images[0]):
        # A difference of two products is not fused, for it must be 0 where both are equal.
        kernel[grid](*arguments, *sizes, **constants, block=BLOCK, enable_fp_fusion=False)
