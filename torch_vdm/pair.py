"""What every metric of two images shares: its options, its checks, its precision."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import fields
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from torch_vdm.images import (
    HIGHEST_CODE,
    MOST_BELOW,
    advice,
    can_be_read,
    finite_in_both,
    has_values,
    is_queued,
    masked,
    range_of,
    refuse_onnx,
    remedy,
    require_finite,
)
from torch_vdm.model.display import Display
from torch_vdm.model.distance import just_noticeable
from torch_vdm.model.grid import Grid
from torch_vdm.observer import Observer
from torch_vdm.options import choice, number
from torch_vdm.precision import computed_in, look_at, widest
from torch_vdm.run import operators
from torch_vdm.run.compiled import for_any_size
from torch_vdm.run.memory import keep_freed_memory
from torch_vdm.run.schedule import Job, Schedule, at_once, chosen

Nonfinite = Literal["raise", "mask"]

# A number, or rows of numbers.
Numbers = float | Sequence["Numbers"]

# Constants that state dicts held before 0.1.0.
FORMER = {field.name for field in fields(Observer)} | {
    "primaries",
    "cones",
    "opponents",
    "luminance_of_cones",
    "dark_cones",
    "frequencies",
    "gains",
    "band_frequencies",
    "band_weights",
    "luminance",
    "sensitivities",
}


class PairMetric(operators.Enrolled):
    """A metric that maps the visible differences of two images.

    Subclasses compute the accumulated differences of two checked batches, bring a plane of them to
    pixel resolution, and set their constants, see `_set_constants`.

    Parameters
    ----------
    ppd, display, nonfinite
        As in `VDM`.

    Raises
    ------
    ValueError
        If a parameter or an image is not as stated.
    """

    def __init__(
        self, ppd: float, display: Display | None = None, nonfinite: Nonfinite = "raise"
    ) -> None:
        super().__init__()
        self.ppd = number("pixels per degree", ppd)
        if not 0.01 <= self.ppd <= 1e6:
            raise ValueError(f"expected pixels per degree between 0.01 and 1e6, got {ppd}")
        if not isinstance(display, Display | None):
            raise ValueError(f"expected display: Display, got {display!r}")
        choice("nonfinite", nonfinite, get_args(Nonfinite))
        self.display = display or Display.srgb()
        self.nonfinite = nonfinite
        self._compiles = False
        self._checkpointed = False
        self._range_is_known = False
        # Whether values out of range are reported if any of the two images has them, or all.
        self._out_of_range_in: Callable[[Iterable[bool]], bool] = any
        keep_freed_memory()

    def _accumulated(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the accumulated differences of two checked batches, (B, 1, h, w)."""
        raise NotImplementedError

    @property
    def _stackable(self) -> bool:
        """Whether `_accumulated` takes items stacked vertically; see `Job`."""
        return False

    def _job(self, test: Tensor, reference: Tensor) -> Job:
        """Return what decides how two batches are compared."""
        gradients = torch.is_grad_enabled()
        return Job(
            len(test),
            (test.shape[-2], test.shape[-1]),
            self._stackable,
            gradients and (test.requires_grad or reference.requires_grad),
            gradients and test.requires_grad != reference.requires_grad,
            self._compiles,
            self._checkpointed,
            is_queued(test),
            torch.compiler.is_compiling(),
        )

    def scheduled(self, test: Tensor, reference: Tensor) -> Schedule:
        """Return how a pair, (B, 3, H, W) twice, is computed."""
        return chosen(self._job(test, reference))

    def _to_pixels(self, plane: Tensor, size: tuple[int, int], grid: Grid | None = None) -> Tensor:
        """Return a plane of `_accumulated`, or of its root, at the resolution of the images.

        ``grid``: that of a part of an image.
        """
        raise NotImplementedError

    def _set_constants(self, constants: Mapping[str, Numbers]) -> None:
        """Keep constants, among them ``summation_exponent``, and register them as buffers.

        They follow from the options: no state dict holds them.
        """
        self._exact = dict(constants)
        for name in constants:
            self.register_buffer(name, None, persistent=False)
        self._place(torch.get_default_device())

    def _place(self, device: torch.device) -> None:
        """Make the constants on a device, anew from exact numbers.

        They are made once for each computing precision, and once more as buffers, which show where
        the module is. A buffer is used if `torch.func.functional_call` replaces it or if it
        requires a gradient; anything else done to it, such as a wrapper's cast to half precision,
        in place or not, changes no result.
        """
        look_at(device)

        def placed(dtype: torch.dtype) -> dict[str, Tensor]:
            return {
                name: torch.tensor(value, dtype=dtype, device=device)
                for name, value in self._exact.items()
            }

        # Tensors made in inference mode could not be used in training later.
        with torch.inference_mode(False):
            self._cast = {dtype: placed(dtype) for dtype in (torch.float32, widest(device))}
            self._own = placed(widest(device))
        self._buffers.update(self._own)

    def _apply(self, fn: Any, recurse: bool = True) -> Self:
        """Move the constants with the module, but never to a lower precision."""
        # In the precision that every device has.
        self._buffers.update(self._cast[torch.float32])
        try:
            super()._apply(fn, recurse)  # type: ignore[no-untyped-call]  # torch's own
        finally:
            self._place(self.get_buffer("summation_exponent").device)
        return self

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **options: Any
    ) -> None:
        """Leave out the constants that older checkpoints hold, with a warning."""
        former = [name for name in FORMER if state_dict.pop(prefix + name, None) is not None]
        if former:
            warnings.warn(
                f"the checkpoint holds {len(former)} constants of {type(self).__name__}, which are "
                "no longer part of a state dict; they are left out, and this module's options stay",
                stacklevel=2,
            )
        super()._load_from_state_dict(state_dict, prefix, *args, **options)

    def compile(self, *args: Any, **kwargs: Any) -> Self:  # type: ignore[override]
        """Switch to the compiled route: one compiled function per level, for any size and batch.

        ``torch.compile`` of the metric, or of a step that calls it, does not do this: there the
        metric is one operator, which takes the same route as elsewhere. This takes no arguments,
        needs a C++ compiler, and returns the module itself, unlike `nn.Module.compile`. A graph
        then serves one backward pass: torch's compiled code retains none, and has no second
        derivatives. Under `torch.func` nothing is compiled.
        """
        if args or kwargs:
            raise ValueError("expected no arguments: the fast route has no options")
        self._compiles = True
        return self

    def forward(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the map of visible differences.

        Parameters
        ----------
        test, reference
            (B, 3, H, W), floating point, as the display expects them.

        Returns
        -------
        Tensor
            (B, 1, H, W), JND.
        """
        if operators.is_wanted() and self._has_own_constants():
            return operators.difference_map(test, reference, self._number, power=False)
        test, reference, seen = self._checked(test, reference, later=True)
        total = self._total(test, reference)
        constants = self._constants(total.dtype, "summation_exponent")
        schedule = self.scheduled(test, reference)
        jnd = schedule.once(just_noticeable, total, constants["summation_exponent"])
        jnd = self._at_pixels(jnd, schedule, (test.shape[-2], test.shape[-1]), seen)
        self._require_finite_later(test, reference)
        return jnd

    def power(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the accumulated differences before the root is taken: the map to a power.

        The power is the summation exponent: 2.4 for the paper's observer, 6 for the calibrated one.

        It is (B, 1, H, W), from (B, 3, H, W) twice, and smooth where the images are equal, so that
        a loss is taken from here; see `VDMLoss`.
        """
        if operators.is_wanted() and self._has_own_constants():
            return operators.difference_map(test, reference, self._number, power=True)
        test, reference, seen = self._checked(test, reference, later=True)
        power = self._power(test, reference, seen)
        self._require_finite_later(test, reference)
        return power

    def _power(self, test: Tensor, reference: Tensor, seen: Tensor | None) -> Tensor:
        """Return `power` of two checked batches."""
        schedule = self.scheduled(test, reference)
        total, size = self._total(test, reference), (test.shape[-2], test.shape[-1])
        return self._at_pixels(total, schedule, size, seen)

    def _at_pixels(
        self, plane: Tensor, schedule: Schedule, size: tuple[int, int], seen: Tensor | None
    ) -> Tensor:
        """Return a plane of `_accumulated`, or of its root, as a map, 0 where a mask is not set."""
        at_pixels = self._to_pixels(plane, size)
        return at_pixels if seen is None else schedule.once(masked, at_pixels, seen)

    def _has_own_constants(self) -> bool:
        """Return whether no constant is replaced, and none requires a gradient."""
        return all(self._is_own(name) for name in self._own)

    def _is_own(self, name: str) -> bool:
        """Return whether a constant is as the options say: unchanged, or cast by a wrapper."""
        buffer = self._buffers[name]
        assert buffer is not None
        same = buffer is self._own[name] or buffer.dtype in (torch.float16, torch.bfloat16)
        return same and not buffer.requires_grad

    def _constants(self, dtype: torch.dtype, *names: str) -> dict[str, Tensor]:
        """Return constants in the precision of the computation: those named, or all."""
        own, cast = self._own, self._cast
        device = own["summation_exponent"].device
        if device != cast[torch.float32]["summation_exponent"].device:  # a wrapper moved buffers
            self._place(device)
            own, cast = self._own, self._cast
        exact, buffers = cast[dtype], self._buffers
        found = {}
        for name in names or own:
            buffer = buffers[name]
            assert buffer is not None
            found[name] = exact[name] if self._is_own(name) else buffer.to(dtype)
        return found

    def _total(self, test: Tensor, reference: Tensor) -> Tensor:
        job = self._job(test, reference)
        items = at_once(job)
        with for_any_size() if chosen(job).compiled else nullcontext():
            if items >= len(test):
                return self._accumulated(test, reference)
            parts = zip(test.split(items), reference.split(items), strict=True)
            # Copies: compiled code is specialised on the offset of a view.
            totals = [self._accumulated(one.clone(), other.clone()) for one, other in parts]
        return torch.cat(totals)

    def _require_image(self, name: str, image: Tensor) -> None:
        """Raise if ``image`` is not what the metric takes, and say how to make it so."""
        if not isinstance(image, Tensor):
            raise ValueError(
                f"expected {name} that is a tensor (B, 3, H, W), got {type(image).__name__}; "
                "torch.from_numpy makes one of an array"
            )
        shape = tuple(image.shape)
        if len(shape) != 4 or shape[1] != 3 or 0 in shape:
            raise ValueError(
                f"expected {name} of shape (B, 3, H, W) with no side of 0, got {shape}"
                f"{remedy(shape)}"
            )
        if not image.is_floating_point():
            raise ValueError(
                f"expected {name} of floating point, got {image.dtype}; "
                "divide 8-bit values by 255, others by the largest that they may have"
            )
        place = self.get_buffer("summation_exponent").device
        if image.device != place:
            raise ValueError(
                f"expected {name} where the metric is, on {place}, got one on {image.device}; "
                f'move the metric with .to("{image.device}")'
            )

    def _checked(
        self,
        test: Tensor,
        reference: Tensor,
        origin: tuple[int, int, int] = (0, 0, 0),
        later: bool = False,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return both images in the computing precision, and where they are finite (masked).

        ``origin`` is where a part lies in a larger batch, for messages: item, y, x. ``later``:
        `_require_finite_later` follows, when the device has been given all else to do.
        """
        refuse_onnx()
        for name, image in (("a test", test), ("a reference", reference)):
            self._require_image(name, image)
        if test.shape != reference.shape:
            raise ValueError(
                "expected two images of one shape, "
                f"got {tuple(test.shape)} and {tuple(reference.shape)}"
            )
        dtype = computed_in(test, reference)
        # In one memory layout: another takes other paths through the vectorised loops, and equal
        # images would differ in their last bits.
        test, reference = test.to(dtype).contiguous(), reference.to(dtype).contiguous()
        seen: Tensor | None = None
        if self.nonfinite == "mask":
            test, reference, seen = self._finite_in_both(test, reference)
        elif not (later and is_queued(test)):
            self._require_finite(test, reference, origin)
        self._look_at_range(test, reference)
        return test, reference, seen

    def _require_finite(
        self, test: Tensor, reference: Tensor, origin: tuple[int, int, int] = (0, 0, 0)
    ) -> None:
        """Raise if an image is not finite, where values are to be read back."""
        if self._reads(test):
            require_finite(test, reference, origin)

    def _require_finite_later(self, test: Tensor, reference: Tensor) -> None:
        """Do so of images that were `_checked` except for this."""
        if is_queued(test):
            self._require_finite(test, reference)

    def _finite_in_both(self, test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return `finite_in_both` of two images in the computing precision."""
        return finite_in_both(test, reference)

    def _reads(self, image: Tensor) -> bool:
        """Return whether values are to be read back, to raise if they are wrong."""
        return self.nonfinite == "raise" and not torch.compiler.is_compiling() and has_values(image)

    def _look_at_range(self, test: Tensor, reference: Tensor) -> None:
        """Warn at the first call if values are not sRGB codes, but bytes or in [-1, 1]."""
        if self._range_is_known or self.display.encoding != "srgb" or not can_be_read(test):
            return
        self._range_is_known = True
        found = torch.stack([range_of(test), range_of(reference)]).tolist()
        wrong = [highest > HIGHEST_CODE or below > MOST_BELOW for _, highest, below in found]
        if self._out_of_range_in(wrong):
            name = ("test", "reference")[wrong.index(True)]
            lowest, highest, below = found[wrong.index(True)]
            warnings.warn(
                f"expected sRGB-coded values in [0, 1], got a {name} from {lowest:.4g} to "
                f"{highest:.4g}; {advice(highest > HIGHEST_CODE, below > MOST_BELOW)}; "
                "only the first call is looked at",
                stacklevel=2,
            )
