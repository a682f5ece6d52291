"""The two-dimensional non-standard Haar decomposition of Eq. 2."""

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torch_vdm.cortex.transform import DEEPEST, Cortex, mean_of
from torch_vdm.fast import SMALLEST, compiled
from torch_vdm.quadtree import complete, own, pad_even


@dataclass(frozen=True)
class Haar:
    """The paper's transform: O(N), one coefficient a pixel and cone, not shift-invariant."""

    shifts = 1
    phases = 1
    reach = 1

    def decompose(self, planes: Tensor, fast: bool = False, true_means: bool = False) -> Cortex:
        """Decompose (B, C, H, W) by Eq. 2 down to one node, by compiled steps if ``fast``.

        ``true_means``: a node at the border counts for the pixels that it has. Else for as many
        as its siblings, as the repeated last row or column of an odd side makes it.

        Returns
        -------
        Cortex
            ``details[l]`` is (B, C, 3, h, w): d1 (horizontal), d2 (vertical), d3 (diagonal).
        """
        size = (planes.shape[-2], planes.shape[-1])
        mean = mean_of(planes)
        details, lowpass = levels(planes, 1, size, fast, true_means)
        return Cortex(tuple(reversed(details)), tuple(reversed(lowpass or [planes])), mean)

    def begin(
        self, planes: Tensor, count: int, fast: bool = False, true_means: bool = False
    ) -> Cortex:
        """Return the ``count`` finest levels of `decompose`, without a mean; arguments as there."""
        size = (planes.shape[-2], planes.shape[-1])
        details, lowpass = levels(planes, 1, size, fast, true_means, count)
        return Cortex(tuple(reversed(details)), tuple(reversed(lowpass)), planes[..., :1, :1])

    def reduced(
        self, planes: Tensor, octaves: int, fast: bool = False, true_means: bool = False
    ) -> Tensor:
        """Return the means of nodes of 2^octaves pixels; arguments as `decompose`."""
        size = (planes.shape[-2], planes.shape[-1])
        return [planes, *levels(planes, 1, size, fast, true_means, octaves)[1]][octaves]

    def resume(
        self,
        plane: Tensor,
        octaves: int,
        size: tuple[int, int],
        mean: Tensor,
        fast: bool = False,
        true_means: bool = False,
    ) -> Cortex:
        """Decompose what `reduced` gives; see `Transform.resume`."""
        # The first step is a level that tiles have.
        _, (plane,) = levels(plane, 2**octaves, size, fast, true_means, 1)
        return self.coarser(plane, octaves + 1, size, mean, fast, true_means)

    def coarser(
        self,
        plane: Tensor,
        octaves: int,
        size: tuple[int, int],
        mean: Tensor,
        fast: bool = False,
        true_means: bool = False,
    ) -> Cortex:
        """Return the levels of `decompose` without its ``octaves`` finest.

        ``plane`` has the means of nodes of 2^octaves pixels; other arguments as in `resume`.
        """
        details, lowpass = levels(plane, 2**octaves, size, fast, true_means)
        return Cortex(tuple(reversed(details)), tuple(reversed(lowpass)), mean, octaves)

    def peak(self, level_from_finest: int) -> tuple[float, float]:
        """Return the best frequency of a level, in cycles/pixel, and the gain there."""
        return _peak(level_from_finest)

    def peaks(self, level_from_finest: int) -> tuple[tuple[float, float], ...]:
        """Return the same, for all three orientations."""
        return (_peak(level_from_finest),)


def levels(
    planes: Tensor,
    node: int,
    size: tuple[int, int],
    fast: bool,
    true_means: bool,
    count: int = DEEPEST,
) -> tuple[list[Tensor], list[Tensor]]:
    """Return details and lowpass of the ``count`` finest levels, the finest first.

    ``planes`` (B, C, h, w) are the means of nodes of ``node`` x ``node`` pixels of an image of
    ``size`` = (H, W) pixels.
    """
    details: list[Tensor] = []
    lowpass: list[Tensor] = []
    while max(planes.shape[-2:]) > 1 and len(details) < count:
        step = compiled(_analyse) if fast and planes.numel() >= SMALLEST else _analyse
        if true_means:
            mean_of_all, detail = step(complete(planes, size, node))
            planes = own(mean_of_all, planes, size, node)
        else:
            planes, detail = step(pad_even(planes))
        details.append(detail)
        lowpass.append(planes)
        node *= 2
    return details, lowpass


def _analyse(even: Tensor) -> tuple[Tensor, Tensor]:
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
    frequency f (cycles/pixel) with sin(pi m f)^2 / (m sin(pi f)). Its greatest maximum is the one
    between 1/(4m) and 1/(2m), where 2 m sin(pi f) cos(pi m f) - cos(pi f) sin(pi m f), the sign of
    its slope, passes 0.
    """
    m = 2**level_from_finest
    if m == 1:
        return 0.5, 1.0
    low, high = 0.25 / m, 0.5 / m
    while (middle := 0.5 * (low + high)) not in (low, high):
        once, many = math.pi * middle, math.pi * m * middle
        slope = 2.0 * m * math.sin(once) * math.cos(many) - math.cos(once) * math.sin(many)
        low, high = (middle, high) if slope > 0.0 else (low, middle)
    return low, math.sin(math.pi * m * low) ** 2 / (m * math.sin(math.pi * low))
