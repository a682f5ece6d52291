"""StationaryHaar and Steerable in NumPy, node by node, from their descriptions in docs/model.md.

Planes are (H, W); details are (orientations, h, w), the finest level first. Every node is summed up
by itself, over the pixels or samples that it covers; an image goes on beyond its border as its last
row and column.
"""

import math

import numpy as np

from .calibrated import CalibratedParameters, glance_weight, lowpass_term, sensitivity
from .paper import (
    ALL_ON,
    SML_TO_OPPONENT,
    XYZ_TO_SML,
    Array,
    Pyramid,
    aberration_factor,
    cone_dark_light,
    cone_fundamentals,
    level_count,
    wavelet_peak,
)
from .sarnoff import BURT, correlate, transfer


def at(plane: Array, y: int, x: int) -> float:
    """Return the value at a place; beyond the border the nearest."""
    y, x = min(max(y, 0), plane.shape[0] - 1), min(max(x, 0), plane.shape[1] - 1)
    return float(plane[y, x])


def box_means(plane: Array, node: int) -> Array:
    """Return the means of nodes side by side; where the image ends, of what they have of it."""
    rows, columns = (-(-side // node) for side in plane.shape)
    return np.array(
        [
            [
                plane[node * y : node * (y + 1), node * x : node * (x + 1)].mean()
                for x in range(columns)
            ]
            for y in range(rows)
        ]
    )


def faded(parts: Array, size: tuple[int, ...], node: int) -> Array:
    """Return parts whose last row and column count for the share r of their pixels they have."""
    parts = parts.copy()
    for axis in (0, 1):
        turned = parts if axis == 0 else parts.T
        share = (size[axis] % node or node) / node
        if len(turned) > 1:
            turned[-1] = turned[-2] + 2.0 * share / (1.0 + share) * (turned[-1] - turned[-2])
    return parts


def stationary_haar(plane: Array) -> list[tuple[Array, Array]]:
    """Return details (3, h, w) and lowpass (h, w) of every level."""
    levels = []
    for level in range(level_count(*plane.shape)):
        height, width = (-(-side // 2**level) for side in plane.shape)
        # Of how many parts a side half a node is made, and the pixels of a part.
        half, pixels = (1, 1) if level == 0 else (2, 2 ** (level - 1))
        parts = faded(box_means(plane, pixels), plane.shape, pixels)
        details, lowpass = np.zeros((3, height, width)), np.zeros((height, width))
        for y in range(height):
            for x in range(width):
                top, left = half * y, half * x
                if level > 0:
                    top += x % 2
                    left += (x + y) % 2
                quarters = np.zeros((2, 2))
                for i in range(2 * half):
                    for j in range(2 * half):
                        quarters[i // half, j // half] += at(parts, top + i, left + j) / half**2
                (a, b), (c, d) = quarters
                details[:, y, x] = (a - b + c - d) / 4, (a + b - c - d) / 4, (a - b - c + d) / 4
                lowpass[y, x] = (a + b + c + d) / 4
        levels.append((details, lowpass))
    return levels


def haar_responses(level: int, frequency: float) -> tuple[float, float]:
    """Return what a level's wavelet and its window leave of a cosine, by summing it up."""
    node = 2 ** (level + 1)
    phases = 2.0 * math.pi * frequency * (np.arange(node) - 0.5 * (node - 1))
    sign = np.where(np.arange(node) < node // 2, 1.0, -1.0)
    return abs(float(np.mean(sign * np.sin(phases)))), float(np.mean(np.cos(phases)))


def diagonal_peak(level: int) -> tuple[float, float]:
    """Return frequency and gain of d3, such that at 45 degrees it makes up for d1 and d2."""
    frequency = wavelet_peak(2**level)[0] / (2.0 * math.pi)
    best = haar_responses(level, frequency)[0]
    wavelet, window = haar_responses(level, frequency / math.sqrt(2.0))
    others = 2.0 * (wavelet * window / best) ** 4
    return math.sqrt(2.0) * frequency, wavelet**2 / (1.0 - others) ** 0.25


def halfway_weights() -> Array:
    """Return the weights of 16 samples around the middle of the 8th and the 9th."""
    x = np.arange(16) - 7.5
    weights = np.sinc(x) * (1.0 + np.cos(math.pi * x / 8.5))
    return np.asarray(weights / weights.sum())


def doubled(plane: Array) -> Array:
    """Return a plane with the values between its samples, each by 16 of them in a row."""
    rows = np.zeros((plane.shape[0], 2 * plane.shape[1]))
    for y in range(rows.shape[0]):
        for x in range(plane.shape[1]):
            rows[y, 2 * x] = plane[y, x]
            near = [at(plane, y, x - 7 + tap) for tap in range(16)]
            rows[y, 2 * x + 1] = np.dot(halfway_weights(), near)
    whole = np.zeros((2 * plane.shape[0], rows.shape[1]))
    for x in range(rows.shape[1]):
        for y in range(plane.shape[0]):
            whole[2 * y, x] = rows[y, x]
            near = [at(rows, y - 7 + tap, x) for tap in range(16)]
            whole[2 * y + 1, x] = np.dot(halfway_weights(), near)
    return whole


def oriented(degrees: float) -> tuple[Array, Array]:
    """Return the even and odd 9 x 9 kernels of Freeman and Adelson 1991, not scaled."""
    x = 0.67 * (np.arange(9) - 4)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    across, down = np.meshgrid(x, x)
    along = c * across + s * down
    radial = np.exp(-(across**2) - down**2)
    linear = (2.254 * c**3 + 3.0 * 0.7515 * c * s * s) * across
    linear += (2.254 * s**3 + 3.0 * 0.7515 * s * c * c) * down
    return (2.0 * along**2 - 1.0) * radial, (along**3 - linear) * radial


def steerable_gains(level: int, frequency: float) -> tuple[float, float]:
    """Return what a level's band and its even and odd filter leave of a grating, cycles/pixel."""
    cycles = frequency * 2.0**level / 2.0  # a sample of the band
    if level == 0:
        places = np.arange(16) - 7.5
        between = np.sum(halfway_weights() * np.cos(2.0 * math.pi * frequency * places))
        band = 0.5 * (1.0 + float(between))
    else:
        band = 1.0
        for finer in range(level - 1):
            band *= transfer(BURT, frequency * 2.0**finer)
    band *= 1.0 - transfer(BURT, cycles)
    wave = np.exp(2j * math.pi * cycles * (np.arange(9) - 4))
    even, odd = (abs(np.sum(kernel * wave[None, :])) for kernel in oriented(0.0))
    return band * float(even), band * float(odd)


def steerable(plane: Array, peaks: list[float]) -> list[tuple[Array, Array]]:
    """Return details (8, h, w), normalised at ``peaks``, and lowpass (h, w) of every level."""
    smoothing = np.outer(BURT, BURT)
    finer, here = doubled(plane), plane
    levels = []
    for level in range(level_count(*plane.shape)):
        band = finer - correlate(finer, smoothing)
        smooth = correlate(here, smoothing)
        even_gain, odd_gain = steerable_gains(level, peaks[level])
        first = 1 if level == 0 else 2
        details, lowpass = np.zeros((8, *here.shape)), np.zeros(here.shape)
        # -45 and not 135 degrees, for the odd filter has a sign.
        for orientation, degrees in enumerate((0.0, 45.0, 90.0, -45.0)):
            even, odd = oriented(degrees)
            # Beyond the border the band, not the filtered plane, goes on.
            wide = np.pad(band, 4, mode="edge")
            filtered = correlate(wide, even) / even_gain, correlate(wide, odd) / odd_gain
            for y in range(here.shape[0]):
                for x in range(here.shape[1]):
                    for phase in range(2):
                        details[2 * orientation + phase, y, x] = filtered[phase][
                            first + 2 * y + 4, first + 2 * x + 4
                        ]
        for y in range(here.shape[0]):
            for x in range(here.shape[1]):
                lowpass[y, x] = at(smooth, y + 1, x + 1)
        levels.append((details, lowpass))
        finer, here = here, smooth[::2, ::2]
    return levels


def box_over_shifts(energy: Array, nodes: int) -> Array:
    """Return at every half of a node the mean over the nodes that cover it and those beside."""
    pooled = np.zeros_like(energy)
    for y in range(energy.shape[0]):
        for x in range(energy.shape[1]):
            pooled[y, x] = np.mean(
                [
                    [at(energy, y + i, x + j) for j in range(-nodes, nodes)]
                    for i in range(-nodes, nodes)
                ]
            )
    return pooled


def level_responses(
    image: Array,
    ppd: float,
    kind: str,
    peaks: list[tuple[float, float]],
    parameters: CalibratedParameters,
) -> list[Array]:
    """Return the signed responses (orientations, 3, h, w) of every level, the finest first.

    ``peaks`` are frequency, cycles/pixel, and gain of every level, for d3 those of `diagonal_peak`.
    """
    cones = cone_fundamentals(image)
    dark = cone_dark_light(parameters.dark_light)
    sml_to_y = np.linalg.inv(XYZ_TO_SML)[1]
    if kind == "stationary":
        planes = [stationary_haar(cone) for cone in cones]
    else:
        planes = [steerable(cone, [frequency for frequency, _ in peaks]) for cone in cones]
    levels = len(planes[0])
    responses = []
    for level in range(levels):
        frequency, gain = peaks[level]
        details = np.stack([cone[level][0] for cone in planes], axis=1)
        lowpass = np.stack([cone[min(level + 1, levels - 1)][1] for cone in planes])
        details[:, 0] *= aberration_factor(
            ppd * frequency, parameters.aberration_cutoff, parameters.aberration_exponent
        )
        weighted = np.zeros(details.shape)
        for y, x in np.ndindex(details.shape[2:]):
            light = lowpass[:, y // 2, x // 2]
            luminance = max(float(sml_to_y @ light), 0.0) + parameters.dark_light
            contrast = details[:, :, y, x] / (np.maximum(light, 0.0) + dark)
            for orientation in range(len(details)):
                f, g = frequency, gain
                if kind == "stationary" and orientation == 2:
                    f, g = diagonal_peak(level)
                opponent = SML_TO_OPPONENT @ contrast[orientation]
                seen = np.array(sensitivity(ppd * f, luminance, parameters))
                weighted[orientation, :, y, x] = opponent * seen / g
        energy = weighted**2
        if kind == "steerable":
            for even in range(0, 8, 2):
                energy[even : even + 2] = energy[even] + energy[even + 1]
        q = parameters.transducer_exponent
        responses.append(2.0**q * weighted / (1.0 + energy) ** q)
    return responses


def pair_differences(
    test: Array,
    reference: Array,
    ppd: float,
    kind: str,
    peaks: list[tuple[float, float]],
    parameters: CalibratedParameters,
) -> list[Array]:
    """Return the squared differences (orientations, 3, h, w); of even and odd, their mean."""
    first, second = (
        level_responses(image, ppd, kind, peaks, parameters) for image in (test, reference)
    )
    squares = [(one - other) ** 2 for one, other in zip(first, second, strict=True)]
    if kind == "steerable":
        squares = [0.5 * (square[0::2] + square[1::2]) for square in squares]
    return squares


def jnd_map(
    test: Array,
    reference: Array,
    ppd: float,
    kind: str,
    peaks: list[tuple[float, float]],
    parameters: CalibratedParameters,
) -> Array:
    """Return the map (H, W), JND, of two images (3, H, W), XYZ in cd/m2."""
    height, width = test.shape[1:]
    cones = [Pyramid((cone_fundamentals(image),), ()) for image in (test, reference)]
    total = np.full((height, width), lowpass_term(cones[0], cones[1], ALL_ON, parameters))
    squares = pair_differences(test, reference, ppd, kind, peaks, parameters)
    for level, square in enumerate(squares):
        local = np.zeros(square.shape[2:])
        for orientation, channel in np.ndindex(square.shape[:2]):
            pooled = box_over_shifts(square[orientation, channel], 3)
            local += pooled ** (0.5 * parameters.summation_exponent)
        for y, x in np.ndindex(height, width):
            total[y, x] += local[y // 2**level, x // 2**level]
    return np.asarray(total ** (1.0 / parameters.summation_exponent))


def score_sum(
    test: Array,
    reference: Array,
    ppd: float,
    kind: str,
    peaks: list[tuple[float, float]],
    parameters: CalibratedParameters,
    exponent: float,
) -> float:
    """Return the largest sum of the detection score, before its root, without the lowpass term.

    A quarter of the nodes are as many as side by side; and a cosine's mean power, found by summing
    it up, is that of its absolute value and not that of its mean square. A glance is one half node
    wider than twice as many half nodes as nodes.
    """
    phase = np.linspace(0.0, 2.0 * math.pi, 100000, endpoint=False)
    spread = np.mean(np.abs(np.cos(phase)) ** exponent) / 0.5 ** (0.5 * exponent)
    height, width = test.shape[1:]
    total = np.zeros((height, width))
    window = 2 * parameters.score_window + 1
    squares = pair_differences(test, reference, ppd, kind, peaks, parameters)
    for level, square in enumerate(squares):
        power = np.zeros(square.shape[2:])
        for orientation, channel in np.ndindex(square.shape[:2]):
            covered = box_over_shifts(square[orientation, channel], 1)
            power += covered ** (0.5 * exponent) * spread / 4.0
        for y, x in np.ndindex(height, width):
            for v, u in np.ndindex(power.shape):
                down = glance_weight(y // 2**level - v, window)
                total[y, x] += down * glance_weight(x // 2**level - u, window) * power[v, u]
    return float(total.max())
