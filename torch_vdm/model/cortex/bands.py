"""Smooth frequency bands that add up to an image, to filter it by contrast sensitivity.

They are a Laplacian pyramid (Burt and Adelson 1983) whose finest octave is split once more, at the
image's own density: the eye's sensitivity falls too fast over the two octaves of its first band.
When the bands are weighted, with weights that may vary from place to place, and summed again, the
image is filtered by whatever the weights follow, such as the local luminance.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.cortex.gaussian import along, response
from torch_vdm.model.cortex.transform import DEEPEST
from torch_vdm.model.interleave import interleaved
from torch_vdm.model.steps import PLAIN, Steps

# Weights of the pyramid's lowpass, cos(pi f)^6: Burt and Adelson's five taps leave aliasing that
# moves a threshold by 2 dB with the phase of a grating. Status: choice, measured.
LOWPASS = (1 / 64, 6 / 64, 15 / 64, 20 / 64, 15 / 64, 6 / 64, 1 / 64)

# Frequencies at which the weights of the second and third band are set, in cycles/pixel; each
# further one is half the previous. They are about the bands' peaks. Status: choice.
SECOND, NEXT = 0.1764, 0.0775

# Planes with more elements are summed in parts, which stay in the processor's cache.
# Status: choice, measured.
LARGEST_AT_ONCE = 2**18

# Bands that constants are made for.
MOST = DEEPEST + 1

# The radius, in samples of a plane, of what a place of its `Scale` is computed from. It follows
# from the weights.
REACH = 10


class Scale(NamedTuple):
    """The bands of a batch of planes that have these planes' own density.

    Attributes
    ----------
    bands
        (B, C, h, w) each, the finest first: one, but two for an image.
    around
        (B, C, h, w): the lowpass at the same places, without these bands and all finer ones.
    lowpass
        The same, (B, C, ceil(h / 2), ceil(w / 2)), before it is expanded to these places: the next
        scale is split from it.
    """

    bands: tuple[Tensor, ...]
    around: Tensor
    lowpass: Tensor


def halo(count: int) -> int:
    """Return how many pixels around a part of an image `gathered` needs at most to be right there.

    The ``count`` finest scales are split from the part, and all others from the whole image.
    """
    # Next to the border of a part the lowpass of a scale is wrong over at most 5 samples.
    wrong = 0
    for _ in range(count):
        wrong = max(REACH + 5, 2 * (wrong + 2))
    return wrong


def lowpass(image: Tensor, count: int, steps: Steps = PLAIN) -> Tensor:
    """Return what is left of (B, C, H, W) without its ``count`` finest scales."""
    here = image
    for scale in range(count):
        here = reduced(_smooth(here, steps) if scale == 0 else here, steps)
    return here


def parted(plane: Tensor, finest: bool, steps: Steps = PLAIN) -> Scale:
    """Split a scale's bands from (B, C, h, w), the image if ``finest``."""
    here = _smooth(plane, steps) if finest else plane
    rest = reduced(here, steps)
    around = expanded(rest, (here.shape[-2], here.shape[-1]), steps)
    band = here - around
    return Scale((plane - here, band) if finest else (band,), around, rest)


def _smooth(image: Tensor, steps: Steps) -> Tensor:
    """Return an image without its finest band."""
    rows = steps(_parted_rows, image)
    smooth: Tensor = steps(_parted_columns, rows)
    return smooth


def gathered(planes: Sequence[Tensor], steps: Steps = PLAIN) -> Tensor:
    """Sum one plane (B, C, h, w) per scale, the finest first, into one of the finest size."""
    total = planes[-1]
    for plane in reversed(planes[:-1]):
        rows = steps.rows(plane.shape[-2], plane.numel(), LARGEST_AT_ONCE)
        if rows >= plane.shape[-2]:
            total = plane + expanded(total, (plane.shape[-2], plane.shape[-1]), steps)
            continue
        parts = plane.split(rows, -2)
        columns = _expanded_columns(total, plane.shape[-2]).split(rows, -2)
        total = torch.cat(
            [
                part.add(_expanded_rows(column, plane.shape[-1]))
                for part, column in zip(parts, columns, strict=True)
            ],
            -2,
        )
    return total


def reduced(plane: Tensor, steps: Steps = PLAIN) -> Tensor:
    """Return the next coarser plane: every second sample, ceil(h / 2) x ceil(w / 2) of them."""
    rows = steps(_reduced_rows, plane)
    columns: Tensor = steps(_reduced_columns, rows)
    return columns


def expanded(plane: Tensor, size: tuple[int, int], steps: Steps = PLAIN) -> Tensor:
    """Return a plane at the ``size`` of the next finer one, interpolated smoothly."""
    columns = steps(_expanded_columns, plane, size[0])
    rows: Tensor = steps(_expanded_rows, columns, size[1])
    return rows


def surrounded(plane: Tensor, width: int, dim: int) -> Tensor:
    """Pad a plane by ``width`` samples on both sides: mirrored, or repeated if it is too short.

    A repeated border gives a grating another mean beyond it, which is visible.
    """
    sides = (width, width, 0, 0) if dim == -1 else (0, 0, width, width)
    mode = "reflect" if plane.shape[dim] > width else "replicate"
    return functional.pad(plane, sides, mode=mode)


def _parted_rows(plane: Tensor) -> Tensor:
    # The lowpass that splits the finest octave has weights of 1/4, 1/2, 1/4: the mean of
    # neighbours, taken twice. Status: choice; half is left at a quarter of a cycle per pixel.
    padded = surrounded(plane, 1, -1)
    means = torch.lerp(padded[..., :-1], padded[..., 1:], 0.5)
    return torch.lerp(means[..., :-1], means[..., 1:], 0.5)


def _parted_columns(plane: Tensor) -> Tensor:
    padded = surrounded(plane, 1, -2)
    means = torch.lerp(padded[..., :-1, :], padded[..., 1:, :], 0.5)
    return torch.lerp(means[..., :-1, :], means[..., 1:, :], 0.5)


def _reduced_rows(plane: Tensor) -> Tensor:
    return along(surrounded(plane, 3, -1), LOWPASS, -1, 2)


def _reduced_columns(plane: Tensor) -> Tensor:
    return along(surrounded(plane, 3, -2), LOWPASS, -2, 2)


def _expanded_rows(plane: Tensor, width: int) -> Tensor:
    return _expanded(plane, -1)[..., :width]


def _expanded_columns(plane: Tensor, height: int) -> Tensor:
    return _expanded(plane, -2)[..., :height, :]


def _expanded(plane: Tensor, dim: int) -> Tensor:
    """Return a plane's values at its samples and half-way after each, in turn along ``dim``."""
    length = plane.shape[dim]
    padded = surrounded(plane, 2, dim)
    before, here, after, far = (padded.narrow(dim, tap, length) for tap in (1, 2, 3, 4))
    even = ((2.0 * LOWPASS[3]) * here).add_(before + after, alpha=2.0 * LOWPASS[1])
    odd = (here + after).mul_(2.0 * LOWPASS[2]).add_(before + far, alpha=2.0 * LOWPASS[0])
    return interleaved(even, odd, dim)


def share(band: int, frequency: float) -> float:
    """Return the share of a grating of ``frequency`` cycles/pixel that a band has in the sum.

    Band 0 is the finest, and all shares add up to 1. The grating passes every reduction and every
    expansion once; aliasing is not counted.
    """
    left = math.cos(math.pi * frequency) ** 2
    if band == 0:
        return 1.0 - left
    for scale in range(band):
        cycles = 2.0**scale * frequency
        passed = response(LOWPASS, cycles) ** 2 if cycles < 0.5 else 0.0
        if scale == band - 1:
            return left * (1.0 - passed)
        left *= passed
    raise AssertionError


def frequencies() -> tuple[float, ...]:
    """Return the frequency in cycles/pixel at which each band's weight is set."""
    return (0.5, SECOND, *(NEXT / 2.0**scale for scale in range(MOST - 2)))


@lru_cache
def weights() -> tuple[tuple[float, ...], ...]:
    """Return the matrix that turns the desired response of a filter into weights of bands.

    The response is given at `frequencies`. The matrix compensates for the overlap of neighbouring
    bands: with these weights the filter has exactly that response there.
    """
    shares = [[share(band, frequency) for band in range(MOST)] for frequency in frequencies()]
    return tuple(tuple(row) for row in np.linalg.inv(shares).tolist())
