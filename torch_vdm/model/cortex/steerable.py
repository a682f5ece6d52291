"""A pyramid of oriented quadrature pairs: no phase, no place and no direction is preferred."""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.cortex import oriented
from torch_vdm.model.cortex.gaussian import blur, lowpass_response
from torch_vdm.model.cortex.transform import CSF, DEEPEST, Base, Cortex, mean_of
from torch_vdm.model.grid import PAPERS, Grid
from torch_vdm.model.interleave import interleaved
from torch_vdm.model.steps import PLAIN, Steps

# Taps on either side of the sinc, under a Hann window, that gives the image half-way between its
# pixels, which the finest level needs. Status: choice.
HALFWAY = 8

# Planes with more elements are filtered in bands of rows, which stay in the processor's cache.
# Status: choice, measured.
LARGEST_AT_ONCE = 2**17

_PLACES = [tap + 0.5 for tap in range(HALFWAY)]
_SINC = [
    math.sin(math.pi * x) / x * (1.0 + math.cos(math.pi * x / (HALFWAY + 0.5))) for x in _PLACES
]
# Weights of the pairs of pixels around the place, the nearest first; their sum is a half.
WEIGHTS = tuple(0.5 * weight / sum(_SINC) for weight in _SINC)


class Peak(NamedTuple):
    """What a level responds to best."""

    frequency: float
    """Cycles/pixel."""
    even: float
    """The gain of the level's band and even filter for a grating there."""
    odd: float
    """The same for the odd filter."""


@dataclass(frozen=True)
class Steerable:
    """Even and odd filters at 0, 45, 90 and 135 degrees on every band of a pyramid.

    A band is a plane of the Gaussian pyramid minus its own lowpass, taken before any sample is
    dropped, so that it has no aliasing of its own. It is filtered by the pairs of
    `torch_vdm.model.cortex.oriented` on a grid twice as dense as its level, for the finest level
    between the image's pixels, and every second place is kept. The nodes lie where those of
    `StationaryHaar` do, with 10.7 times the coefficients of `Haar`.

    Even and odd responses are kept apart, with their signs: the two images are compared by the
    length of the difference of their pairs, which does not depend on phase.
    """

    # Its bands are narrow: no level responds to gratings of other levels.
    csf: ClassVar[CSF] = "levels"
    shifts = 2
    phases = 2
    reach = 12

    _peaks: tuple[Peak, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Find the peaks once: a graph of torch.compile takes them as constants."""
        object.__setattr__(self, "_peaks", tuple(_peak(level) for level in range(DEEPEST)))

    def grid(self, size: tuple[int, int], true_means: bool) -> Grid:  # noqa: ARG002
        """Return where the nodes lie on an image: the first begin with it."""
        return PAPERS

    def decompose(
        self,
        planes: Tensor,
        steps: Steps = PLAIN,
        true_means: bool = False,  # noqa: ARG002  # see below
        *,
        grid: Grid | None = None,  # noqa: ARG002  # as `grid`
    ) -> Cortex:
        """Decompose (B, C, H, W) to the coarsest level, step by step.

        ``true_means`` changes nothing: no sample of this pyramid stands for repeated pixels.

        Returns
        -------
        Cortex
            ``details[l]`` is (B, C, 8, h, w): for 0, 45, 90 and 135 degrees the even and the odd
            response, each 1 at a level's best frequency for a grating of amplitude 1. Sizes are
            those of `StationaryHaar`.
        """
        mean = steps.once(mean_of, planes)
        band = _doubled(_doubled(planes, -1), -2)
        return self._cortex(planes, band - blur(band, steps), 0, mean, steps)

    def begin(
        self,
        planes: Tensor,
        count: int,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,  # noqa: ARG002  # as `grid`
    ) -> tuple[Cortex, Tensor]:
        """Return the finest levels, and what `rest` continues from; see `Transform.begin`."""
        band = _doubled(_doubled(planes, -1), -2)
        none = planes[..., :1, :1]
        cortex = self._cortex(planes, band - blur(band, steps), 0, none, steps, count)
        return cortex, self.reduced(planes, count - 2, steps, true_means)

    def rest(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Return the coarser levels; see `Transform.rest`."""
        return self.resume(base, steps, true_means)

    def reduced(
        self,
        planes: Tensor,
        octaves: int,
        steps: Steps = PLAIN,
        true_means: bool = False,  # noqa: ARG002  # as in `decompose`
        *,
        grid: Grid | None = None,  # noqa: ARG002  # as `grid`
    ) -> Tensor:
        """Return the Gaussian pyramid's plane; arguments as in `decompose`."""
        for _ in range(octaves):
            planes = _dropped(blur(planes, steps))
        return planes

    def resume(
        self,
        base: Base,
        steps: Steps = PLAIN,
        true_means: bool = False,  # noqa: ARG002  # as in `decompose`
    ) -> Cortex:
        """Decompose the rest of an image; see `Transform.resume`."""
        smooth = blur(base.plane, steps)
        band = base.plane - smooth
        return self._cortex(_dropped(smooth), band, base.octaves + 1, base.mean, steps)

    def _cortex(
        self,
        plane: Tensor,
        band: Tensor,
        finest: int,
        mean: Tensor,
        steps: Steps,
        count: int = DEEPEST,
    ) -> Cortex:
        """Return the levels from ``finest`` on, from its plane and the band that it is made from.

        There are at most ``count``.
        """
        details: list[Tensor] = []
        lowpass: list[Tensor] = []
        all_levels = (max(plane.shape[-2:]) - 1).bit_length()
        for level in range(finest, finest + min(all_levels, count)):
            size = (plane.shape[-2], plane.shape[-1])
            # The nodes lie between those of the next finer level: at the odd samples of the doubled
            # image, or at the even samples except the first on all other levels.
            peak = self._peaks[level]
            details.append(_responses(band, size, 1 if level == 0 else 2, peak, steps))
            smooth = blur(plane, steps)
            lowpass.append(_next(smooth))
            band, plane = plane - smooth, _dropped(smooth)
        return Cortex(tuple(reversed(details)), tuple(reversed(lowpass or [plane])), mean, finest)

    def peaks(self, level_from_finest: int) -> tuple[tuple[float, float], ...]:
        """Return the best frequency of a level, in cycles/pixel, and the gain there: 1."""
        return ((self._peaks[level_from_finest].frequency, 1.0),)


def _doubled(plane: Tensor, dim: int) -> Tensor:
    """Return a plane with one sample inserted half-way after every sample along ``dim``."""
    sides = (HALFWAY - 1, HALFWAY, 0, 0) if dim == -1 else (0, 0, HALFWAY - 1, HALFWAY)
    padded = functional.pad(plane, sides, mode="replicate")
    length = plane.shape[dim]
    between = torch.zeros_like(plane)
    for tap, weight in enumerate(WEIGHTS):
        pair = padded.narrow(dim, HALFWAY - 1 - tap, length)
        between = between + weight * (pair + padded.narrow(dim, HALFWAY + tap, length))
    return interleaved(plane, between, dim)


def _dropped(plane: Tensor) -> Tensor:
    """Return every second sample of a plane."""
    return plane[..., ::2, ::2].contiguous()


def _next(plane: Tensor) -> Tensor:
    """Return a plane shifted by one, so that each sample is that of the next row and column."""
    padded = functional.pad(plane, (0, 1, 0, 1), mode="replicate")
    return padded[..., 1:, 1:].contiguous()


def _responses(band: Tensor, size: tuple[int, int], first: int, peak: Peak, steps: Steps) -> Tensor:
    """Return the responses (B, C, 8, h, w) to a band at every second place from ``first``."""
    reach = oriented.REACH
    more = [
        first + 2 * (nodes - 1) + reach + 1 - places
        for nodes, places in zip(size, band.shape[-2:], strict=True)
    ]
    padded = functional.pad(band, (reach, more[1], reach, more[0]), mode="replicate")
    padded = padded[..., first:, first:]
    rows = steps.rows(size[0], band.numel(), LARGEST_AT_ONCE)
    parts = []
    for top in range(0, size[0], rows):
        end = 2 * min(top + rows, size[0]) - 1 + 2 * reach
        across = steps(oriented.across, padded[..., 2 * top : end, :], 2)
        parts.append(steps(_paired, across, peak.even, peak.odd))
    return torch.cat(parts, -2) if len(parts) > 1 else parts[0]


def _paired(rows: tuple[Tensor, ...], even: float, odd: float) -> Tensor:
    pairs = oriented.quadrature(rows, even, odd, 2)
    return torch.stack([response for pair in pairs for response in pair], 2)


@lru_cache
def _peak(level_from_finest: int) -> Peak:
    """Maximise the gain of the pyramid and the even filter for a grating along a row.

    Between 1/4 and 4 times the frequency at which the filter alone is best, about a quarter of a
    cycle per sample, there is one maximum. Aliasing is not counted.
    """
    samples = 0.5 * 2.0**level_from_finest  # cycles/sample of the band per cycle/pixel

    def band(frequency: float) -> float:
        if level_from_finest == 0:
            between = 2.0 * sum(
                weight * math.cos(2.0 * math.pi * frequency * x)
                for weight, x in zip(WEIGHTS, _PLACES, strict=True)
            )
            passed = 0.5 * (1.0 + between)
        else:
            passed = 1.0
        for finer in range(level_from_finest - 1):
            passed *= lowpass_response(2.0**finer * frequency)
        return passed * (1.0 - lowpass_response(samples * frequency))

    def left(frequency: float) -> float:
        return band(frequency) * oriented.even_gain(samples * frequency)

    low, high = 0.1 / samples, (0.25 if level_from_finest == 0 else 0.4) / samples
    ratio = 0.5 * (math.sqrt(5.0) - 1.0)
    while high - low > 1e-9 * high:
        one, other = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, other) if left(one) > left(other) else (one, high)
    frequency = 0.5 * (low + high)
    passed = band(frequency)
    return Peak(
        frequency,
        passed * oriented.even_gain(samples * frequency),
        passed * oriented.odd_gain(samples * frequency),
    )
