"""Parts of the model as kernels of Triton, forward and backward, for GPUs.

A step of `Haar`, the local visual differences of all levels, the way down the quad-tree and the
mask of pixels that are not finite are one launch each, where the model's steps are many operations,
each of which a GPU waits for. On a processor only Triton's interpreter runs kernels, for tests: it
does so where TRITON_INTERPRET=1 was set before they are first used.
"""

from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor

from torch_vdm.effects import Effects
from torch_vdm.images import has_values
from torch_vdm.model.cortex import Haar, Transform
from torch_vdm.observer import Observer

# Nodes, or parents, of a program. Status: choice, not measured.
BLOCK = 128

# The summation exponent that the kernels are written for: that of the calibrated observer.
EXPONENT = 6.0


def require(observer: Observer, transform: Transform, effects: Effects) -> None:
    """Raise ValueError where there are no kernels for these options, or no Triton."""
    known = (
        observer.signed
        and observer.adaptation_luminance is None
        and observer.summation_exponent == EXPONENT
    )
    for right, what in (
        (known, f'with the observer "{observer.name}"; it is of the calibrated one'),
        (transform == Haar(), f"with {transform}; it is of Haar() alone"),
        (effects == Effects(), "with effects left out; it has all of them"),
    ):
        if not right:
            raise ValueError(f"expected a schedule without the kernel, got one {what}")
    if find_spec("triton") is None:
        raise ValueError(
            "expected Triton for a schedule with the kernel, got none: pip install triton"
        )


def of(module: str, plane: Tensor) -> Any:
    """Return a module of kernels; raise ValueError if they cannot run where a plane is."""
    kernels = import_module(f"torch_vdm.run.kernels.{module}")
    there = has_values(plane)
    if not there or (plane.device.type == "cpu" and not kernels.INTERPRETED):
        got = f"on {plane.device}" if there else "without values"
        raise ValueError(
            f"expected images on a GPU for a schedule with the kernel, got them {got}; leave the "
            "kernel out, or set TRITON_INTERPRET=1 to try it slowly"
        )
    return kernels


def differentiated(
    function: Callable[..., Tensor],
    planes: Sequence[Tensor],
    wanted: Sequence[bool],
    gradient: Tensor,
) -> list[Tensor | None]:
    """Return the gradients by those planes that are ``wanted``, as autograd does, for another one.

    ``function`` returns what the kernel does, by steps of the model.
    """
    views = [plane.view_as(plane) for plane in planes]
    inputs = [view for view, want in zip(views, wanted, strict=True) if want]
    found = iter(torch.autograd.grad(function(*views), inputs, gradient, create_graph=True))
    return [next(found) if want else None for want in wanted]


def programs(nodes: int, block: int) -> int:
    """Return how many programs have so many nodes, a block each."""
    return -(-nodes // block)


def launch(
    kernel: Any,
    count: int,
    items: int,
    planes: Sequence[Tensor],
    sizes: Sequence[int],
    block: int | None = None,
    **constants: bool,
) -> None:
    """Launch a kernel with ``count`` programs for each of so many ``items``; ``block``: `BLOCK`."""
    # A difference of two products is not fused, for it must be 0 where both are equal.
    options = {**constants, "block": block or BLOCK, "enable_fp_fusion": False}
    with torch.cuda.device_of(planes[0]):
        kernel[count, items](*planes, *sizes, **options)
