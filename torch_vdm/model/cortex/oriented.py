"""Steerable quadrature pairs: the second derivative of a Gaussian and its Hilbert transform.

W. T. Freeman and E. H. Adelson, The Design and Use of Steerable Filters (IEEE Transactions on
Pattern Analysis and Machine Intelligence 13, 1991), tables III to VI: 9 taps 0.67 apart. Seven
basis filters, each a product of two of five one-dimensional ones, give every direction.
"""

import math

from torch import Tensor

from torch_vdm.model.cortex.gaussian import along, response

# Taps, their spacing, and the coefficients of x in the odd filters. Status: source.
TAPS, SPACING = 9, 0.67
LINEAR, CROSSED_LINEAR = 2.254, 0.7515

# Samples that the filters need on every side.
REACH = TAPS // 2

_PLACES = [SPACING * (tap - REACH) for tap in range(TAPS)]
GAUSSIAN = tuple(math.exp(-x * x) for x in _PLACES)
FIRST = tuple(x * math.exp(-x * x) for x in _PLACES)
SECOND = tuple((2.0 * x * x - 1.0) * math.exp(-x * x) for x in _PLACES)
THIRD = tuple((x**3 - LINEAR * x) * math.exp(-x * x) for x in _PLACES)
CROSSED = tuple((x * x - CROSSED_LINEAR) * math.exp(-x * x) for x in _PLACES)


def even_gain(frequency: float) -> float:
    """Return the gain of the even filter for a grating in its direction, in cycles/sample."""
    return response(SECOND, frequency) * sum(GAUSSIAN)


def odd_gain(frequency: float) -> float:
    """Return the gain of the odd filter for a grating in its direction, in cycles/sample."""
    return response(THIRD, frequency) * sum(GAUSSIAN)


def across(plane: Tensor, step: int = 1) -> tuple[Tensor, ...]:
    """Filter the rows of (..., h, w + 8) with the five one-dimensional filters."""
    filters = (GAUSSIAN, FIRST, SECOND, THIRD, CROSSED)
    return tuple(along(plane, weights, -1, step) for weights in filters)


def quadrature(
    rows: tuple[Tensor, ...], even: float, odd: float, step: int = 1
) -> list[tuple[Tensor, Tensor]]:
    """Return the even and odd responses at 0, 45, 90 and 135 degrees, (..., h, w) each.

    ``rows`` are what `across` gives, (..., h + 8, w); ``even`` and ``odd`` are the gains that
    responses are divided by. 0 degrees is a vertical grating, 45 one whose phase increases to the
    right and down.
    """
    smooth, first, second, third, crossed = rows
    xx = along(second, GAUSSIAN, -2, step) / even
    xy = along(first, FIRST, -2, step) * (2.0 / even)
    yy = along(smooth, SECOND, -2, step) / even
    xxx = along(third, GAUSSIAN, -2, step) / odd
    xxy = along(crossed, FIRST, -2, step) * (3.0 / odd)
    xyy = along(first, CROSSED, -2, step) * (3.0 / odd)
    yyy = along(smooth, THIRD, -2, step) / odd
    # Along (c, s): c^2 xx + 2 c s xy + s^2 yy, and c^3 xxx + c^2 s xxy + c s^2 xyy + s^3 yyy.
    half, root = 0.5, 0.5**1.5
    straight, turned = half * (xx + yy), xy
    right, down = root * (xxx + xyy), root * (yyy + xxy)
    return [
        (xx, xxx),
        (straight + turned, right + down),
        (yy, yyy),
        (straight - turned, right - down),
    ]
