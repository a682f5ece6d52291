"""How a pair of images is computed: chosen in one place, from what is known in advance."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import is_fake
from torch.utils.checkpoint import checkpoint

from torch_vdm.model.cortex import bands
from torch_vdm.model.steps import Steps
from torch_vdm.run.compiled import SMALLEST, compiled
from torch_vdm.run.gradients import by_hand, is_plain
from torch_vdm.run.gradients.steps import STEPS as BY_HAND
from torch_vdm.run.kernels.steps import STEPS as BY_KERNEL
from torch_vdm.run.stacked import apart, below, rows_lost, unviewed
from torch_vdm.run.tiling import Tiling, cut

# Planes with more elements are computed in parts, which stay in a processor's cache. Status:
# choice, measured.
LARGEST_AT_ONCE = 2**18

# Pixels of a strip of a large image, and how many levels, from the finest, are computed in strips.
# Status: choice, measured.
STRIP, STRIP_LEVELS = 3 * 2**17, 2

# Pixels of a strip in which a large image is filtered. Status: choice, measured.
BAND_STRIP = 2**17

# Levels of at most so many nodes are computed at once: there, calling an operation costs more than
# its arithmetic. Status: choice, measured.
FEW_NODES = 96 * 96

# More nodes than any level has.
EVERY_LEVEL = 2**62


class Job(NamedTuple):
    """What decides how a pair is computed."""

    items: int
    size: tuple[int, int]
    stackable: bool
    """Whether items may be stacked vertically: with `Haar` alone."""
    gradients: bool
    """Whether a backward pass may follow."""
    one_sided: bool
    """Whether only one of the two images has a gradient."""
    compiles: bool
    """Whether the compiled route was asked for."""
    checkpoints: bool
    """Whether little is to be kept for the backward pass."""
    accelerated: bool
    """Whether it runs on a GPU or the like."""
    traced: bool
    """Whether it is traced into someone else's graph, which is one whatever its pieces are."""


@dataclass(frozen=True)
class Schedule(Steps):
    """How a pair is computed."""

    pieces: Literal["whole", "strips"] = "whole"
    """How the finest levels of an image are cut."""
    stacked: bool = False
    """Whether compiled steps get the items of a batch below one another."""
    together: bool = False
    """Whether both images are decomposed as one batch."""
    compiled: bool = False
    """Whether large steps are compiled."""
    again: bool = False
    """Whether the backward pass recomputes parts, and only their arguments are kept."""
    cached: bool = True
    """As `Steps.cached`."""
    few: int = field(default_factory=lambda: FEW_NODES)
    """Levels of at most this many nodes are computed at once."""
    kernel: bool = False
    """Whether what has kernels of Triton is computed by them; see `torch_vdm.run.kernels`."""

    @property
    def by_kernel(self) -> bool:
        """Whether kernels are used here: not for what is traced or transformed."""
        return self.kernel and is_plain()

    @property
    def fused(self) -> bool:
        """As `Steps.fused`."""
        return self.compiled

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a step returns, using its compiled form where that pays."""
        if self._has_kernel(function):
            return BY_KERNEL[function](*arguments)
        first = _first(arguments)
        if not self._compiles(first):
            return self.form(function, first)(*arguments)
        items = first.shape[0]
        if not self.stacked or items == 1:
            return compiled(function)(*arguments)
        return apart(compiled(function)(*below(arguments, items)), items)

    def once(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a pure function returns, on a GPU by as few operations as possible."""
        if self.cached or not self._may_compile(_first(arguments)):
            return function(*arguments)
        # A user's image, or half of a batch, may be a part of another.
        whole = (_unviewed(each) if isinstance(each, Tensor) else each for each in arguments)
        return compiled(function)(*whole)

    def form(self, function: Callable[..., Any], first: Tensor) -> Callable[..., Any]:
        """Return what gives the same as a step, uncompiled, if its first plane is ``first``."""
        return BY_HAND.get(function, function) if first.requires_grad and by_hand() else function

    def valid(self, function: Callable[..., Any], around: Tensor, *arguments: Any) -> Any:
        """Return what a step returns of planes that come with their neighbours."""
        items = around.shape[0]
        if not self._compiles(around) or not self.stacked or items == 1:
            return self(function, around, *arguments)
        found = compiled(function)(*below((around, *arguments), items))
        return apart(found, items, rows_lost(around, found, items))

    def padded(
        self,
        function: Callable[..., Any],
        pad: Callable[[Tensor, Any], Tensor],
        planes: Tensor,
        sides: Any,
        *arguments: Any,
    ) -> Any:
        """Return what a step returns of planes that are padded before; a kernel pads by itself."""
        if self._has_kernel(function):
            return BY_KERNEL[function](planes, sides, *arguments)
        return super().padded(function, pad, planes, sides, *arguments)

    def _has_kernel(self, function: Callable[..., Any]) -> bool:
        """Return whether a step is computed by a kernel."""
        return self.by_kernel and function in BY_KERNEL

    def _compiles(self, first: Tensor) -> bool:
        """Return whether a step with this first plane is compiled."""
        # A side that becomes 1 would need another form.
        large = first.numel() >= SMALLEST and first.shape[-2] > 2
        return large and self._may_compile(first)

    def _may_compile(self, first: Tensor) -> bool:
        """Return whether steps are compiled: not under `torch.func`, nor without values."""
        return self.compiled and is_plain() and not is_fake(first)

    def part(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what several steps return; compiled graphs choose by themselves what they keep."""
        if not self.again or not torch.is_grad_enabled():
            return function(*arguments)
        return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)

    def pixels(self, function: Callable[..., Tensor], *planes: Tensor) -> Tensor:
        """Return the value of a pointwise function of pixels, a few rows at a time."""
        if self.compiled:
            # A user's image may be a part of another.
            return function(*map(_unviewed, planes))
        if not self.cached:
            found: Tensor = self.part(function, *planes)
            return found
        rows = self.rows(planes[0].shape[-2], planes[0].numel(), LARGEST_AT_ONCE)
        parts = zip(*(plane.split(rows, -2) for plane in planes), strict=True)
        return torch.cat([self.part(function, *part) for part in parts], -2)

    def strips(
        self, function: Callable[[Tensor], tuple[Tensor, Tensor]], plane: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return `filtering`'s function of a plane, in strips if it is large."""
        size = plane.shape[-2], plane.shape[-1]
        few = math.prod(size) < 2 * BAND_STRIP
        if few or self.compiled or not self.cached or torch.compiler.is_compiling():
            whole: tuple[Tensor, Tensor] = self.part(function, plane)
            return whole
        tiling = Tiling.strips(size, BAND_STRIP, 0, 1, bands.REACH)
        pieces = []
        for strip, around in zip(tiling, tiling.split_rows(plane), strict=True):
            found = self.part(function, around)
            pieces.append([cut(part, strip.within(n)) for n, part in enumerate(found, 1)])
        contrast, lowpass = (torch.cat(parts, -2) for parts in zip(*pieces, strict=True))
        return contrast, lowpass

    def rows(self, height: int, numbers: int, most: int) -> int:
        """Return how many of ``height`` rows, ``numbers`` elements in all, are computed at once."""
        return height if self.compiled or not self.cached else max(1, most * height // numbers)


def chosen(job: Job) -> Schedule:
    """Return the best schedule for a job."""
    compiles = job.compiles and not job.traced
    again = job.checkpoints and job.gradients and not job.traced
    if job.accelerated:
        # Few operations, as large as possible: calling one takes as long as a million elements.
        return Schedule(
            together=not job.one_sided,
            compiled=compiles,
            again=again,
            cached=False,
            # Levels computed at once keep all their intermediate results.
            few=0 if job.traced else FEW_NODES if again else EVERY_LEVEL,
        )
    # With gradients strips take less memory and more time, as checkpoints do.
    large = math.prod(job.size) >= 2 * STRIP
    strips = large and not job.traced and (job.checkpoints or not job.gradients)
    small = job.items * 3 * math.prod(job.size) <= LARGEST_AT_ONCE
    return Schedule(
        "strips" if strips else "whole",
        together=small and not (compiles or job.traced or job.one_sided),
        stacked=compiles and job.items > 1 and job.stackable,
        compiled=compiles,
        again=again,
        # For sides that are symbols it is not known where nodes lie in a column.
        few=0 if job.traced else FEW_NODES,
    )


def at_once(job: Job) -> int:
    """Return how many items of a batch are computed at once.

    Compiled code for one item serves a stacked batch, of as many pixels as are not yet cut into
    strips.
    """
    if not job.compiles or job.traced:
        return job.items
    return max(1, 2 * STRIP // math.prod(job.size)) if job.stackable else 1


def _first(arguments: tuple[Any, ...]) -> Tensor:
    """Return the first plane of the arguments of a step."""
    first = arguments[0]
    plane: Tensor = first if isinstance(first, Tensor) else first[0]
    return plane


def _unviewed(plane: Tensor) -> Tensor:
    """Return a plane that is not a view, and begins where its memory does."""
    return unviewed(plane.clone() if plane.storage_offset() else plane, plane.shape)
