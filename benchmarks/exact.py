"""One coefficient from light to JND with 50 digits, beside the metric's own stages in float64.

What a float64 reference cannot show: that the stages lose nothing themselves. Local contrast,
opponents, contrast sensitivity, masking, difference and root, from the formulas.
"""

from collections.abc import Sequence
from typing import Any

import mpmath
import torch
from mpmath import mpf

from torch_vdm import VDM, Observer
from torch_vdm.model.cones import XYZ_TO_SML
from torch_vdm.model.contrast import SML_TO_OPPONENTS
from torch_vdm.model.cortex import Cortex

DIGITS = 50

# Of the finest level, the next, and one of 1 cycle/degree, at 60 pixels/degree.
LEVELS = (0, 1, 5)

# Lowpass of S, M, L; details of the two images, as shares of it: faint to strong.
LIGHT = ((0.01, 0.02, 0.04), (12.0, 20.0, 40.0), (3e4, 4e4, 1e5))
SHARES = ((1e-7, 0.0), (0.003, -0.002), (0.3, 0.29), (0.9, -0.7))


def largest_error(observer: Observer) -> float:
    """Return the largest relative error over levels, lights and details."""
    worst = 0.0
    with mpmath.workdps(DIGITS):
        for level in LEVELS:
            for light in LIGHT:
                for shares in SHARES:
                    # Three orientations, of which the cones see each a little differently.
                    details = [
                        [[share * cone * (1.0 + 0.3 * o * k) for o in range(3)]
                         for k, cone in enumerate(light)]
                        for share in shares
                    ]  # fmt: skip
                    exact = _exact(observer, level, light, details)
                    here = _computed(observer, level, light, details)
                    worst = max(worst, float(abs(mpf(here) - exact) / exact))
    return worst


def _computed(
    observer: Observer, level: int, light: Sequence[float], details: list[list[list[float]]]
) -> float:
    """Return the JND of one node by the metric's stages."""
    metric = VDM(60.0, observer=observer)
    lowpass = torch.tensor(light, dtype=torch.float64).view(1, 3, 1, 1)
    cortices = [
        Cortex(
            (torch.tensor(planes, dtype=torch.float64).view(1, 3, 3, 1, 1),),
            (lowpass,),
            lowpass,
            finest=level,
        )
        for planes in details
    ]
    power = metric.compare(cortices[0], cortices[1])
    jnd: float = power.item() ** (1.0 / observer.summation_exponent)
    return jnd


def _exact(
    observer: Observer, level: int, light: Sequence[float], details: list[list[list[float]]]
) -> Any:
    """Return the same from the formulas of docs/model.md, with as many digits as are set."""
    constants = dict(VDM(60.0, observer=observer).named_buffers())
    frequency = mpf(constants["frequencies"][level, 0].item())
    gain = mpf(constants["gains"][level, 0].item())
    cones = [[mpf(value) for value in row] for row in XYZ_TO_SML]
    to_luminance = (mpmath.matrix(cones) ** -1)[1, :]
    dark = mpf(observer.dark_light)
    adapted = [mpf(value) + dark * sum(row) for value, row in zip(light, cones, strict=True)]
    luminance = sum(to_luminance[k] * mpf(light[k]) for k in range(3)) + dark
    short = mpmath.exp(
        -((frequency / mpf(observer.aberration_cutoff)) ** mpf(observer.aberration_exponent))
    )
    sensitivities = [value / gain for value in _sensitivities(observer, frequency, luminance)]
    responses = []
    for planes in details:
        # Channels, of all orientations each.
        weighted: list[list[Any]] = [[], [], []]
        for orientation in range(3):
            contrasts = [
                mpf(planes[k][orientation]) * (short if k == 0 else 1) / adapted[k]
                for k in range(3)
            ]
            for channel, row in enumerate(SML_TO_OPPONENTS):
                mixed = sum(mpf(w) * contrast for w, contrast in zip(row, contrasts, strict=True))
                weighted[channel].append(sensitivities[channel] * mixed)
        responses.append(weighted)
    exponent = mpf(observer.summation_exponent)
    # One channel's orientations of one image and of the other.
    total = sum(
        difference**exponent
        for one, other in zip(*responses, strict=True)
        for difference in _differences(observer, one, other)
    )
    # One node: its 3x3 mean is itself.
    return total ** (1 / mpf(observer.summation_exponent))


def _sensitivities(observer: Observer, frequency: Any, luminance: Any) -> list[Any]:
    """Return the contrast sensitivities of A, C1 and C2."""
    o = {name: mpf(value) for name, value in observer.numbers().items()}
    chromatic = [
        o[f"{name}_gain"]
        / mpmath.sqrt(1 + (frequency / o[f"{name}_cutoff"]) ** (2 * o[f"{name}_order"]))
        for name in ("red_green", "yellow_violet")
    ]
    if observer.adaptation_luminance is not None:
        around = o["adaptation_luminance"]
        a = 540 * (1 + mpf("0.7") / around) ** mpf("-0.2")
        a /= 1 + 12 / (o["achromatic_size"] * (1 + frequency / 3) ** 2)
        b = mpf("0.3") * (1 + 100 / around) ** mpf("0.15")
        barten = a * frequency * mpmath.exp(-b * frequency)
        barten *= mpmath.sqrt(1 + mpf("0.06") * mpmath.exp(b * frequency))
        return [o["achromatic_gain"] * barten, *chromatic]
    dark = 1 + o["dim_luminance"] / luminance
    glare = 1 + luminance / o["glare_luminance"]
    peak = o["peak_frequency"] * (1 + o["peak_luminance"] / luminance) ** -o["peak_exponent"]
    octaves = mpmath.log(frequency / peak, 2)
    shape = mpmath.exp(-((abs(octaves) / o["band_width"]) ** mpf("1.5")))
    if octaves <= 0:
        shape = o["band_floor"] + (1 - o["band_floor"]) * shape
    achromatic = o["achromatic_gain"] * shape * dark ** -o["achromatic_dimming"]
    achromatic *= glare ** -o["glare_exponent"]
    return [achromatic, *(value * dark ** -o["chromatic_dimming"] for value in chromatic)]


def _differences(observer: Observer, first: list[Any], second: list[Any]) -> list[Any]:
    """Return the differences of weighted contrasts, one an orientation, 1 at threshold."""
    if not observer.signed:
        first, second = (
            [2 * v ** mpf("2.25") / (v ** mpf("2.05") + 1) for v in map(abs, image)]
            for image in (first, second)
        )
        return [abs(one - other) for one, other in zip(first, second, strict=True)]
    q = mpf(observer.transducer_exponent)
    masks = sum(v**2 for v in first + second)
    return [
        abs(one - other) * (2 / (1 + masks)) ** q for one, other in zip(first, second, strict=True)
    ]
