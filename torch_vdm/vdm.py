"""The visual difference metric: the stages of Fig. 2, in order. Only this file knows the order."""

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor, nn

from torch_vdm.aberration import attenuation
from torch_vdm.cones import XYZ_TO_SML, cone_responses
from torch_vdm.contrast import (
    SML_TO_OPPONENTS,
    adapted,
    local_contrast,
    opponents,
    weber_contrast,
)
from torch_vdm.cortex import Cortex, Haar, Transform
from torch_vdm.csf import barten, butterworth, dimming
from torch_vdm.display import BT709_TO_XYZ, Display
from torch_vdm.distance import accumulate, just_noticeable, local_visual_difference
from torch_vdm.effects import Effects
from torch_vdm.fast import SMALLEST, compiled
from torch_vdm.masking import energy_transducer, signed_transducer
from torch_vdm.matrix import mix
from torch_vdm.observer import Observer
from torch_vdm.pooling import pool, surround
from torch_vdm.quadtree import push

Nonfinite = Literal["raise", "mask"]

# Levels that the constants are made for: an image of 2^24 pixels a side.
DEEPEST = 24

# Planes with more numbers are computed in parts. Status: choice, measured.
LARGEST_AT_ONCE = 2**20


class Level(NamedTuple):
    """What a level of the transform responds to."""

    frequency: Tensor
    """0-dim, cycles/degree: the frequency of its best response."""
    gain: Tensor
    """0-dim: what its contrast is divided by."""


class VDM(nn.Module):
    """The visual difference metric of Bolin and Meyer 1999 as a module.

    Calling it with a test and a reference image, both (B, 3, H, W), gives the map of their
    visible differences, (B, 1, H, W) in just-noticeable differences: 1 is just noticeable. The
    order of the two makes no difference, and equal images give exactly 0.

    It computes in float64 where an input is float64, else in float32, under autocast too; its
    constants are float64 buffers and keep that precision through `half()` and the like.

    Parameters
    ----------
    ppd
        Pixels in one degree of the visual field; see `pixels_per_degree`.
    display
        What the pixel values are; `Display.srgb()` by default.
    observer
        Who looks; `Observer.calibrated()` by default.
    transform
        How the image is decomposed; `Haar()` by default.
    effects
        What is simulated; everything by default.
    nonfinite
        "raise": NaN or infinity in an image is a ValueError that names the batch item (a graph
        of torch.compile cannot raise: there it gives NaN). "mask": such pixels are taken as
        equal in both images, and the map is 0 there; nothing is read back from the device.

    Raises
    ------
    ValueError
        Where a parameter or an image is not as stated.
    """

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        observer: Observer | None = None,
        transform: Transform | None = None,
        effects: Effects | None = None,
        nonfinite: Nonfinite = "raise",
    ) -> None:
        super().__init__()
        if not 0.01 <= ppd <= 1e6:
            raise ValueError(f"expected pixels per degree between 0.01 and 1e6, got {ppd}")
        for name, option, kind in (
            ("display", display, Display),
            ("observer", observer, Observer),
            ("effects", effects, Effects),
        ):
            if not isinstance(option, kind | None):
                raise ValueError(f"expected {name}: {kind.__name__}, got {option!r}")
        if nonfinite not in ("raise", "mask"):
            raise ValueError(f'expected nonfinite "raise" or "mask", got {nonfinite!r}')
        self.ppd = float(ppd)
        self.display = display or Display.srgb()
        self.observer = observer or Observer.calibrated()
        self.transform = transform or Haar()
        self.effects = effects or Effects()
        self.nonfinite = nonfinite
        self._fast = False

        peaks = [self.transform.peak(level) for level in range(DEEPEST)]
        cones = torch.tensor(XYZ_TO_SML, dtype=torch.float64)
        constants = {
            "primaries": BT709_TO_XYZ,
            "cones": XYZ_TO_SML,
            "opponents": SML_TO_OPPONENTS if self.effects.chromatic else SML_TO_OPPONENTS[:1],
            "luminance_of_cones": torch.linalg.inv(cones)[1:2],
            "dark_cones": self.observer.dark_light * cones.sum(1),
            "frequencies": [self.ppd * frequency for frequency, _ in peaks],
            "gains": [gain if self.observer.level_gain else 1.0 for _, gain in peaks],
            **self.observer.numbers(),
        }
        if self.observer.lowpass_gains is not None:
            channels = 3 if self.effects.chromatic else 1
            constants["lowpass_gains"] = self.observer.lowpass_gains[:channels]
        for name, value in constants.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64))

    @classmethod
    def paper(cls, ppd: float = 60.0, display: Display | None = None, **options: Any) -> Self:
        """Return the metric with the paper's observer, every equation as printed."""
        return cls(ppd, display, observer=Observer.paper(), **options)

    def extra_repr(self) -> str:
        """Return the options."""
        return (
            f"ppd={self.ppd}, display={self.display}, observer={self.observer.name}, "
            f"transform={self.transform}, effects={self.effects.names()}"
        )

    def _apply(self, fn: Any, recurse: bool = True) -> Self:
        """Move the constants with the module, but never to a lower precision."""
        exact = dict(self._buffers)
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]  # torch's own, without types
        for name, moved in self._buffers.items():
            constant = exact[name]
            if moved is not None and constant is not None and moved.dtype != constant.dtype:
                self._buffers[name] = constant.to(moved.device)
        return self

    def compile(self, *args: Any, **kwargs: Any) -> Self:  # type: ignore[override]
        """Switch to the fast route: one compiled function a level, for any size and batch.

        Unlike ``torch.compile(metric)``, which compiles the graph of all levels anew for each
        size. Takes no arguments; returns the module itself, where `nn.Module.compile` returns
        nothing. Needs a C++ compiler.
        """
        if args or kwargs:
            raise ValueError("expected no arguments: the fast route has no options")
        self._fast = True
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
        total, seen = self._total(test, reference)
        jnd = just_noticeable(total, self._constants(total.dtype)["summation_exponent"])
        return _masked(push(jnd, (test.shape[-2], test.shape[-1])), seen)

    def power(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the accumulated differences before the root: the map to the power of 2.4.

        (B, 1, H, W), from (B, 3, H, W) twice. Smooth where the images are equal, so that a loss
        is taken from here; see `VDMLoss`.
        """
        total, seen = self._total(test, reference)
        return _masked(push(total, (test.shape[-2], test.shape[-1])), seen)

    def score(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the detection score of each item, (B,), JND: the image as one stimulus.

        A Minkowski sum of the response differences over all coefficients, so that a larger
        stimulus is easier to detect, where the map stays local.
        """
        test, reference, _ = self._checked(test, reference)
        constants = self._constants(test.dtype)
        exponent = constants["score_exponent"]
        totals = []
        for one, other in self._parts(test, reference):
            first, second = self.represent(one), self.represent(other)
            total = (self.lowpass_difference(first, second) ** exponent).sum((1, 2, 3))
            for seen, expected in zip(self.respond(first), self.respond(second), strict=True):
                total = total + ((seen - expected).abs() ** exponent).sum((1, 2, 3, 4))
            totals.append(total)
        return just_noticeable(torch.cat(totals) / constants["score_coefficients"], exponent)

    def represent(self, image: Tensor) -> Cortex:
        """Return the cortex representation of an image: display, cones, transform.

        ``image`` is (B, 3, H, W) in float32 or float64, as the display expects it.
        """
        constants = self._constants(image.dtype)
        around = self.display, constants["primaries"], constants["cones"]
        if self._fast:
            planes: Tensor = compiled(_light)(image, *around)
        else:
            rows = max(1, LARGEST_AT_ONCE * image.shape[-2] // image.numel())
            planes = torch.cat([_light(part, *around) for part in image.split(rows, -2)], -2)
        return self.transform.decompose(planes, self._fast, self.observer.true_means)

    def respond(self, cortex: Cortex) -> tuple[Tensor, ...]:
        """Return the responses of one image: chromatic aberration to the transducer.

        One (B, channels, orientations, h, w) a level, level 0 first; 1 is threshold.
        """
        constants = self._constants(cortex.lowpass[0].dtype)
        return tuple(
            _response(
                detail,
                *self._sight(cortex, number, level, constants),
                constants["opponents"],
                constants["transducer_exponent"],
                self.observer.signed,
                self.effects.masking,
            )
            for number, (detail, level) in enumerate(
                zip(cortex.details, self._levels(cortex, constants), strict=True)
            )
        )

    def lowpass_difference(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the weighted contrast between the means of two images, the lowpass term.

        (B, channels, 1, 1), not negative, 1 at threshold; 0 for an observer that never compares
        them. A uniform change is seen here and nowhere else.
        """
        one, other = first.mean, second.mean
        constants = self._constants(one.dtype)
        if self.observer.lowpass_gains is None:
            return 0.0 * one[:, :1]  # of the graph, so that an image of one pixel has a gradient
        contrast = weber_contrast(one, other, constants["dark_cones"])
        gains = constants["lowpass_gains"].view(-1, 1, 1)
        return (opponents(contrast, constants["opponents"]) * gains).abs()

    def compare(self, first: Cortex, second: Cortex) -> Tensor:
        """Return the accumulated differences of two representations, before the root.

        (B, 1, h, w) of the finest level. The responses of a level are taken and dropped one
        level at a time, which bounds memory.
        """
        constants = self._constants(first.lowpass[0].dtype)
        root = self.lowpass_difference(first, second) ** constants["summation_exponent"]
        local = self.local_differences(first, second)
        return accumulate(local, root.sum(1, keepdim=True))

    def local_differences(self, first: Cortex, second: Cortex) -> tuple[Tensor, ...]:
        """Return the local visual difference of every node (Eq. 5), before the root.

        One (B, 1, h, w) a level, level 0 first.
        """
        constants = self._constants(first.lowpass[0].dtype)
        return tuple(
            self._local_difference(first, second, number, level, constants)
            for number, level in enumerate(self._levels(first, constants))
        )

    def _local_difference(
        self,
        first: Cortex,
        second: Cortex,
        number: int,
        level: Level,
        constants: dict[str, Tensor],
    ) -> Tensor:
        """Return the local visual difference (B, 1, h, w) of one level."""
        details = first.details[number], second.details[number]
        around = (
            *self._sight(first, number, level, constants),
            *self._sight(second, number, level, constants),
            constants["opponents"],
            constants["transducer_exponent"],
            self.observer.signed,
            self.effects.masking,
        )
        exponent = constants["summation_exponent"]
        size = details[0].numel()
        fast = self._fast and size >= SMALLEST
        respond = compiled(_response_difference) if fast else _response_difference
        gather = compiled(_pooled_difference) if fast else _pooled_difference
        # One orientation at a time where the planes are large: what is computed on the way then
        # stays in the processor's cache. Compiled code keeps nothing on the way.
        at_once = fast or size <= LARGEST_AT_ONCE
        parts = [details] if at_once else zip(*(d.split(1, 2) for d in details), strict=True)
        local: list[Tensor] = []
        for one, other in parts:
            difference = respond(one, other, *around)
            if self.effects.pooling:
                local.append(gather(surround(difference), exponent))
            else:
                local.append(local_visual_difference(difference, exponent))
        return torch.stack(local).sum(0) if len(local) > 1 else local[0]

    def _sight(
        self, cortex: Cortex, number: int, level: Level, constants: dict[str, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Return what turns a level's details into contrasts and weights them.

        For each cone (B, 3, h, w): the share that chromatic aberration leaves, over the parent's
        adaptation; scaled at the parents, of which there are fewer. For each channel the contrast
        sensitivity, (B, channels, h, w), or one node of it where it is everywhere the same.
        """
        parent = cortex.parent_lowpass(number)
        size = (cortex.details[number].shape[-2], cortex.details[number].shape[-1])
        fast = self._fast and parent.numel() >= SMALLEST
        at_parents = compiled(_scale_and_sensitivity) if fast else _scale_and_sensitivity
        scale, sensitivity = at_parents(
            parent, level, constants, self.observer.adaptation_luminance is None, self.effects
        )
        if self.observer.adaptation_luminance is None:
            sensitivity = push(sensitivity, size)
        return push(scale, size), sensitivity

    def _levels(self, cortex: Cortex, constants: dict[str, Tensor]) -> list[Level]:
        """Return what each level of ``cortex`` responds to, level 0 (the coarsest) first."""
        count = len(cortex.details)
        frequencies, gains = constants["frequencies"], constants["gains"]
        # Copies, for compiled code is specialised on the offset of a view.
        return [Level(frequencies[n].clone(), gains[n].clone()) for n in reversed(range(count))]

    def _constants(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """Return the constants in the precision of the computation."""
        return {name: value.to(dtype) for name, value in self.named_buffers()}

    def _total(self, test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor | None]:
        test, reference, seen = self._checked(test, reference)
        totals = [
            self.compare(self.represent(one), self.represent(other))
            for one, other in self._parts(test, reference)
        ]
        return torch.cat(totals), seen

    def _parts(self, test: Tensor, reference: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield both batches, whole or, on the fast route, item by item."""
        if not self._fast or len(test) == 1:
            return iter([(test, reference)])
        # A compiled function is specialised on a batch of one and on the offset of a view.
        return (
            (one.clone(), other.clone())
            for one, other in zip(test.split(1), reference.split(1), strict=True)
        )

    def _checked(self, test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return both images in the computing precision, and where they are finite (masked)."""
        for name, image in (("test", test), ("reference", reference)):
            if image.ndim != 4 or image.shape[1] != 3 or 0 in image.shape:
                raise ValueError(
                    f"expected a {name} of shape (B, 3, H, W) with no side of 0, "
                    f"got {tuple(image.shape)}"
                )
            if not image.is_floating_point():
                raise ValueError(
                    f"expected a {name} of floating point, got {image.dtype}; "
                    "divide 8-bit values by 255"
                )
        if test.shape != reference.shape:
            raise ValueError(
                "expected two images of one shape, "
                f"got {tuple(test.shape)} and {tuple(reference.shape)}"
            )
        double = torch.float64 in (test.dtype, reference.dtype)
        dtype = torch.float64 if double else torch.float32
        # In one layout: a tensor in another takes other paths through the vectorised loops, and
        # equal images would differ in their last bits.
        test, reference = (
            _widened(test, dtype).contiguous(),
            _widened(reference, dtype).contiguous(),
        )
        if self.nonfinite == "mask":
            return finite_in_both(test, reference)
        if not torch.compiler.is_compiling():
            _require_finite("test", test)
            _require_finite("reference", reference)
        return test, reference, None


def finite_in_both(test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both images with 0 where a channel of either is not finite, and where all are.

    (B, 3, H, W) twice, and (B, 1, H, W), boolean.
    """
    seen = (torch.isfinite(test) & torch.isfinite(reference)).all(1, keepdim=True)
    return torch.where(seen, test, 0.0), torch.where(seen, reference, 0.0), seen


def _light(image: Tensor, display: Display, primaries: Tensor, cones: Tensor) -> Tensor:
    """Return the cone responses (B, 3, H, W) to an image on a display."""
    return cone_responses(display.to_xyz(image, primaries), cones)


def _response(
    details: Tensor,
    scale: Tensor,
    sensitivity: Tensor,
    matrix: Tensor,
    exponent: Tensor,
    signed: bool,
    masking: bool,
) -> Tensor:
    """Return the responses of one level of one image: local contrast to the transducer."""
    contrast = opponents(local_contrast(details, scale), matrix)
    weighted = contrast * sensitivity.unsqueeze(2)
    if signed:
        return signed_transducer(weighted, exponent) if masking else weighted
    return energy_transducer(weighted * weighted) if masking else weighted.abs()


def _response_difference(
    details: Tensor,
    other_details: Tensor,
    scale: Tensor,
    sensitivity: Tensor,
    other_scale: Tensor,
    other_sensitivity: Tensor,
    matrix: Tensor,
    exponent: Tensor,
    signed: bool,
    masking: bool,
) -> Tensor:
    """Return the difference of two images' responses at a level, absolute where they are signed.

    Each image by itself: equal images then take equal paths through the vectorised loops, and
    their difference is exactly 0.
    """
    response = _response(details, scale, sensitivity, matrix, exponent, signed, masking)
    other = _response(
        other_details, other_scale, other_sensitivity, matrix, exponent, signed, masking
    )
    return (response - other).abs() if signed else response - other


def _scale_and_sensitivity(
    parent: Tensor, level: Level, constants: dict[str, Tensor], local: bool, effects: Effects
) -> tuple[Tensor, Tensor]:
    """Return what `VDM._sight` pushes to the nodes, on the plane of their parents."""
    scale = adapted(parent, constants["dark_cones"]).reciprocal()
    if effects.aberration:
        passed = attenuation(
            level.frequency, constants["aberration_cutoff"], constants["aberration_exponent"]
        )
        scale = scale * passed.view(3, 1, 1)
    if local:
        seen = mix(constants["luminance_of_cones"], parent).clamp_min(0.0)
        luminance = seen + constants["dark_light"]
    else:
        luminance = constants["adaptation_luminance"].view(1, 1, 1, 1)
    return scale, _sensitivity(luminance, level, constants, effects)


def _sensitivity(
    luminance: Tensor, level: Level, constants: dict[str, Tensor], effects: Effects
) -> Tensor:
    """Return the contrast sensitivity of every channel, (B, channels, h, w), at a level."""
    frequency = level.frequency
    achromatic = constants["achromatic_gain"] * barten(
        frequency, luminance, constants["achromatic_size"]
    )
    channels = [achromatic]
    if effects.chromatic:
        for name in ("red_green", "yellow_violet"):
            bright = butterworth(
                frequency,
                constants[f"{name}_gain"],
                constants["chromatic_cutoff"],
                constants["chromatic_order"],
            )
            dim = dimming(luminance, constants[f"{name}_luminance"], constants[f"{name}_exponent"])
            channels.append(bright * dim)
    return torch.cat(channels, 1) / level.gain


def _pooled_difference(surrounded: Tensor, exponent: Tensor) -> Tensor:
    """Return the local visual difference of response differences, pooled.

    Printed responses are pooled as a difference, for pooling is linear; signed ones come as an
    absolute difference, for neighbours alternate and would cancel.
    """
    return local_visual_difference(pool(surrounded), exponent)


class _Widen(torch.autograd.Function):
    """A cast to more bits whose gradient saturates on the way back instead of overflowing."""

    generate_vmap_rule = True

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        return tangent.to(ctx.wide)

    @staticmethod
    def forward(image: Tensor, dtype: torch.dtype) -> Tensor:
        return image.to(dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, torch.dtype], _: Tensor) -> None:
        ctx.dtype, ctx.wide = inputs[0].dtype, inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        largest = torch.finfo(ctx.dtype).max
        return gradient.clamp(-largest, largest).to(ctx.dtype), None


def _widened(image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an image in ``dtype``, which holds at least as much as its own."""
    if image.dtype not in (torch.float16, torch.bfloat16):
        return image.to(dtype)
    widened: Tensor = _Widen.apply(image, dtype)
    return widened


def _masked(plane: Tensor, seen: Tensor | None) -> Tensor:
    return plane if seen is None else torch.where(seen, plane, 0.0)


def _require_finite(name: str, image: Tensor) -> None:
    """Raise where ``image`` has NaN or infinity, naming the first such item and pixel."""
    # One cheap pass: the sum of an image that is not finite is not.
    if bool(torch.isfinite(image.detach().sum())):
        return
    bad = ~torch.isfinite(image.detach())
    if not bool(bad.any()):
        return
    item = int(bad.flatten(1).any(1).nonzero()[0])
    channel, y, x = bad[item].nonzero()[0].tolist()
    raise ValueError(
        f"expected finite pixel values, got {int(bad[item].sum())} NaN or infinite ones in the "
        f"{name}'s batch item {item}, the first in channel {channel} at x {x}, y {y}; "
        'repair them or pass nonfinite="mask"'
    )
