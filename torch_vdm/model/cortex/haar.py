"""The two-dimensional non-standard Haar decomposition of Eq. 2."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torch_vdm.model.cortex.border import (
    Across,
    Down,
    analyse_at_border,
    is_inside,
    means_at_border,
    weights,
    with_siblings,
)
from torch_vdm.model.cortex.transform import CSF, DEEPEST, Base, Cortex, checked_csf, mean_of
from torch_vdm.model.grid import PAPERS, Grid, thirds
from torch_vdm.model.quadtree import pad_even
from torch_vdm.model.steps import PLAIN, Steps

# The exponent of the sum over coefficients in which a diagonal grating is made as strong as a
# vertical one; it is that of the detection score. Status: choice.
EXPONENT = 4.0

# For this: the number of gratings over an octave, its lowest frequency in cycles/pixel, and the
# number of levels that respond to them.
OCTAVE, LOWEST, SEEING = 16, 1 / 32, 8


@dataclass(frozen=True)
class Haar:
    """The paper's transform: O(N), one coefficient per pixel and cone, not shift-invariant.

    Parameters
    ----------
    csf
        Where contrast sensitivity acts. "levels": on the coefficients, at each level's frequency,
        as in the paper. "filter": on the image before its decomposition, at every frequency.

    Raises
    ------
    ValueError
        If ``csf`` is neither.
    """

    csf: CSF = "levels"

    shifts = 1
    phases = 1
    reach = 1

    def __post_init__(self) -> None:
        """Refuse an unknown option."""
        checked_csf(self.csf)

    def grid(self, size: tuple[int, int], true_means: bool) -> Grid:
        """Return where the nodes lie on an image: `thirds` with ``true_means``."""
        return thirds(size) if true_means else PAPERS

    def decompose(
        self,
        planes: Tensor,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,
    ) -> Cortex:
        """Decompose (B, C, H, W) by Eq. 2 down to one node, step by step.

        ``true_means``: a node at the border counts for the pixels that it has. Otherwise it counts
        for as many as its siblings, as the repeated last row or column of an odd side makes it.
        ``grid``: that of a part of an image.

        Returns
        -------
        Cortex
            ``details[l]`` is (B, C, 3, h, w): d1 (horizontal), d2 (vertical), d3 (diagonal).
        """
        size = (planes.shape[-2], planes.shape[-1])
        base = Base(planes, 0, size, steps.once(mean_of, planes))
        return self.coarser(base, steps, true_means, grid=grid)

    def begin(
        self,
        planes: Tensor,
        count: int,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,
    ) -> tuple[Cortex, Tensor]:
        """Return the finest levels, and what `rest` continues from; see `Transform.begin`."""
        size = (planes.shape[-2], planes.shape[-1])
        base = Base(planes, 0, size, planes[..., :1, :1])
        cortex = self.coarser(base, steps, true_means, count, grid=grid)
        return cortex, cortex.lowpass[1]

    def rest(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Return the coarser levels; see `Transform.rest`."""
        return self.coarser(base, steps, true_means)

    def reduced(
        self,
        planes: Tensor,
        octaves: int,
        steps: Steps = PLAIN,  # noqa: ARG002  # as in `decompose`
        true_means: bool = False,
        *,
        grid: Grid | None = None,
    ) -> Tensor:
        """Return the means of nodes of 2^octaves pixels; arguments as in `decompose`."""
        size = (planes.shape[-2], planes.shape[-1])
        if grid is None:
            grid = self.grid(size, true_means)
        return [planes, *lowpasses(planes, 0, size, true_means, octaves, grid)][octaves]

    def resume(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Decompose the rest of an image; see `Transform.resume`."""
        # The first step is a level that tiles already have.
        grid = self.grid(base.size, true_means)
        _, (plane,), _ = levels(base.plane, base.octaves, base.size, steps, true_means, grid, 1)
        rest = base._replace(plane=plane, octaves=base.octaves + 1)
        return self.coarser(rest, steps, true_means)

    def coarser(
        self,
        base: Base,
        steps: Steps = PLAIN,
        true_means: bool = False,
        count: int = DEEPEST,
        grid: Grid | None = None,
    ) -> Cortex:
        """Return the levels of `decompose`, at most ``count``, without its ``base.octaves`` finest.

        The plane of ``base`` holds the means of nodes of 2^octaves pixels.
        """
        plane, octaves, size, mean = base
        if grid is None:
            grid = self.grid(size, true_means)
        found = levels(plane, octaves, size, steps, true_means, grid, count)
        details, lowpass, windows = (tuple(reversed(planes)) for planes in found)
        return Cortex(details, lowpass or (plane,), mean, octaves, grid, windows or None)

    def peak(self, level_from_finest: int) -> tuple[float, float]:
        """Return the best frequency of a level, in cycles/pixel, and the gain there."""
        return _peak(level_from_finest)

    def peaks(self, level_from_finest: int) -> tuple[tuple[float, float], ...]:
        """Return the same, for all three orientations.

        For a filtered image the gain of d3 makes up for the weaker response of d1 and d2 to a
        diagonal grating; on the paper's levels it equals theirs.
        """
        frequency, gain = _peak(level_from_finest)
        if self.csf == "levels":
            return ((frequency, gain),)
        return (frequency, gain), (frequency, gain), (frequency, gain * diagonal_share())


def levels(
    planes: Tensor,
    octaves: int,
    size: tuple[int, int],
    steps: Steps,
    true_means: bool,
    grid: Grid,
    count: int = DEEPEST,
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Return details, lowpass and windows of the ``count`` finest levels, the finest first.

    ``planes`` (B, C, h, w) are the means of nodes of 2^octaves pixels a side, placed by ``grid`` on
    an image of ``size`` = (H, W) pixels.
    """
    found = _descended(
        planes, octaves, size, true_means, grid, count, steps, analyse, analyse_at_border
    )
    # Away from the border a window is the node.
    windows = [window[0] if window else lowpass for lowpass, _, *window in found]
    return [detail for _, detail, *_ in found], [lowpass for lowpass, *_ in found], windows


def lowpasses(
    planes: Tensor,
    octaves: int,
    size: tuple[int, int],
    true_means: bool,
    count: int = DEEPEST,
    grid: Grid = PAPERS,
) -> list[Tensor]:
    """Return the lowpass planes that `levels` does, without the details."""
    found = _descended(
        planes, octaves, size, true_means, grid, count, PLAIN, _means, means_at_border
    )
    return [lowpass for (lowpass,) in found]


def lowpass_of_light(cortex: Cortex, light: Base, true_means: bool) -> Cortex:
    """Return a representation of filtered planes with the mean and lowpass of their light.

    What is decomposed behind a filter is not light, but the light decides which pixels differ.
    ``light``: cone responses, from which the levels of ``cortex`` or finer ones follow. The lowpass
    of a level holds the means of the quarters of its nodes, on the plane of its details where these
    overlap, and otherwise on one with sides twice as long.
    """
    if not cortex.details:
        return cortex._replace(mean=light.mean)
    first = cortex.finest - light.octaves
    last = first + len(cortex.details)
    means = lowpasses(light.plane, light.octaves, light.size, true_means, last - 1, cortex.grid)
    planes = [light.plane, *means][first:last]
    return cortex._replace(mean=light.mean, lowpass=tuple(reversed(planes)))


def _descended(
    planes: Tensor,
    octaves: int,
    size: tuple[int, int],
    true_means: bool,
    grid: Grid,
    count: int,
    steps: Steps,
    inside: Callable[[Tensor], tuple[Tensor, ...]],
    at_border: Callable[[Tensor, Down, Across], tuple[Tensor, ...]],
) -> list[tuple[Tensor, ...]]:
    """Return what a function gives for a plane of even sides, the lowpass first, level by level.

    ``inside`` is a function of whole nodes alone; ``at_border`` one that knows which are not whole.
    """
    found: list[tuple[Tensor, ...]] = []
    while (nodes := (planes.shape[-2], planes.shape[-1])) != (1, 1) and len(found) < count:
        sides = grid.sides(size, octaves + len(found))
        if not true_means or (not steps.fused and all(map(is_inside, sides, nodes))):
            planes, *details = steps(inside, pad_even(planes))
        else:
            of = weights(sides, nodes, planes)
            planes, *details = steps.padded(at_border, with_siblings, planes, sides, *of)
        found.append((planes, *details))
    return found


def _means(even: Tensor) -> tuple[Tensor]:
    """Return the lowpass of `analyse` alone; faster than torch's own average of 2x2."""
    sums = (even[..., 0::2, :] + even[..., 1::2, :]).mul_(0.25)
    return (sums[..., 0::2] + sums[..., 1::2],)


def analyse(even: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lowpass (B, C, h/2, w/2) and the details (B, C, 3, h/2, w/2) of a plane, Eq. 2."""
    top, bottom = even[..., 0::2, :], even[..., 1::2, :]
    sums, differences = (top + bottom).mul_(0.25), (top - bottom).mul_(0.25)
    left, right = sums[..., 0::2], sums[..., 1::2]
    upper, lower = differences[..., 0::2], differences[..., 1::2]
    return left + right, torch.stack((left - right, upper + lower, upper - lower), 2)


@lru_cache
def _peak(level_from_finest: int) -> tuple[float, float]:
    """Maximise the magnitude of the wavelet's own response.

    A wavelet of 2m pixels, the mean of m pixels minus the mean of the next m, halved, passes the
    frequency f (cycles/pixel) with the gain sin(pi m f)^2 / (m sin(pi f)). Its largest maximum lies
    between 1/(4m) and 1/(2m), where 2 m sin(pi f) cos(pi m f) - cos(pi f) sin(pi m f), which has
    the sign of its slope, crosses 0.
    """
    m = 2**level_from_finest
    if m == 1:
        return 0.5, 1.0
    low, high = 0.25 / m, 0.5 / m
    while (middle := 0.5 * (low + high)) not in (low, high):
        once, many = math.pi * middle, math.pi * m * middle
        slope = 2.0 * m * math.sin(once) * math.cos(many) - math.cos(once) * math.sin(many)
        low, high = (middle, high) if slope > 0.0 else (low, middle)
    return low, wavelet_response(m, low)


def wavelet_response(half: int, frequency: float) -> float:
    """Return the gain of a wavelet of 2 ``half`` pixels for a grating, in cycles/pixel."""
    return math.sin(math.pi * half * frequency) ** 2 / (half * math.sin(math.pi * frequency))


def window_response(half: int, frequency: float) -> float:
    """Return the gain of the mean of 2 ``half`` pixels for a grating, in cycles/pixel."""
    turn = math.pi * frequency
    return math.sin(2 * half * turn) / (2 * half * math.sin(turn))


@lru_cache
def diagonal_share() -> float:
    """Return d3's gain, relative to that of d1 and d2, that makes all directions equally strong.

    A grating of equal sensitivity on all levels is decomposed at 0 and at 45 degrees; the sums over
    all coefficients, to the power of EXPONENT, are equal on average over an octave. This is for
    coarse levels, which are alike.
    """
    straight = less = diagonal = 0.0
    for place in range(OCTAVE):
        frequency = 2.0 ** (place / OCTAVE) * LOWEST
        along = frequency / math.sqrt(2.0)
        for level in range(SEEING):
            half, gain = 2**level, _peak(level)[1]
            straight += (wavelet_response(half, frequency) / gain) ** EXPONENT
            wavelet = wavelet_response(half, along) / gain
            less += 2.0 * (wavelet * window_response(half, along)) ** EXPONENT
            diagonal += (wavelet * wavelet_response(half, along)) ** EXPONENT
    return float((diagonal / (straight - less)) ** (1.0 / EXPONENT))
