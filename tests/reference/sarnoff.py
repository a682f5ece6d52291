"""The Sarnoff VDM of Lubin 1995 in NumPy, stage by stage, from its description in docs/model.md.

Luminance planes are (H, W), cd/m2. Every filter is a full two-dimensional kernel, correlated tap by
tap over an image whose border is repeated. Nothing is shared with the module that it checks.
"""

import math

import numpy as np

from .paper import Array, barten

GRID_PPD = 120.0
OCTAVES = 7
BAND_FREQUENCY = 32.0 / 120.0  # cycles/sample
EXPONENT = 2.4
DARK_LIGHT = 1e-4  # cd/m2
ADAPTATION = 100.0  # cd/m2
TARGET = 12.0  # degrees
BURT = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0


def correlate(plane: Array, kernel: Array) -> Array:
    """Return the correlation with an odd kernel; the border is repeated."""
    rows, columns = kernel.shape
    padded = np.pad(plane, ((rows // 2, rows // 2), (columns // 2, columns // 2)), mode="edge")
    total = np.zeros_like(plane)
    for row in range(rows):
        for column in range(columns):
            part = padded[row : row + plane.shape[0], column : column + plane.shape[1]]
            total += kernel[row, column] * part
    return total


def line_spread(ppd: float) -> Array:
    """Return Westheimer's line spread at the pixels within 7 minutes of arc (rounded up)."""
    reach = math.ceil(7.0 * ppd / 60.0)
    x = np.abs(np.arange(-reach, reach + 1)) * 60.0 / ppd
    spread = 0.47 * np.exp(-3.3 * x**2) + 0.53 * np.exp(-0.93 * x)
    return np.asarray(spread / spread.sum())


def optics(luminance: Array, ppd: float) -> Array:
    """Return the light on the retina."""
    spread = line_spread(ppd)
    return correlate(correlate(luminance, spread[None, :]), spread[:, None])


def interpolated(line: Array, size: int, cubic: bool) -> Array:
    """Return a line resampled to ``size``; the kernel widens where samples become fewer."""
    scale = len(line) / size
    stretch = max(scale, 1.0)
    support = (2.0 if cubic else 1.0) * stretch
    result = np.zeros(size)
    for place in range(size):
        centre = scale * (place + 0.5)
        first = max(int(centre - support + 0.5), 0)
        last = min(int(centre + support + 0.5), len(line))
        weights = []
        for sample in range(first, last):
            x = abs(sample + 0.5 - centre) / stretch
            if not cubic:
                weights.append(max(1.0 - x, 0.0))
            elif x < 1.0:  # Keys 1981, a = -1/2
                weights.append(1.5 * x**3 - 2.5 * x**2 + 1.0)
            elif x < 2.0:
                weights.append(-0.5 * x**3 + 2.5 * x**2 - 4.0 * x + 2.0)
            else:
                weights.append(0.0)
        result[place] = np.dot(weights, line[first:last]) / np.sum(weights)
    return result


def resampled(plane: Array, size: tuple[int, ...], cubic: bool) -> Array:
    """Return a plane at another size."""
    wide = np.stack([interpolated(row, size[1], cubic) for row in plane])
    return np.stack([interpolated(column, size[0], cubic) for column in wide.T]).T


def reduced(plane: Array) -> Array:
    """Return the next coarser lowpass plane of Burt and Adelson."""
    return correlate(plane, np.outer(BURT, BURT))[::2, ::2]


def expanded(plane: Array, height: int, width: int) -> Array:
    """Return a plane between whose samples zeros are put and smoothed with 4 times the weights."""
    padded = np.pad(plane, 1, mode="edge")
    zeros = np.zeros((2 * padded.shape[0], 2 * padded.shape[1]))
    zeros[::2, ::2] = padded
    smooth = correlate(zeros, 4.0 * np.outer(BURT, BURT))
    return smooth[2 : 2 + height, 2 : 2 + width]


def contrasts(luminance: Array) -> list[Array]:
    """Return the seven bands over the lowpass two levels down, the finest first."""
    lowpass = [luminance]
    for _ in range(OCTAVES + 1):
        lowpass.append(reduced(lowpass[-1]))
    bands = []
    for octave in range(OCTAVES):
        plane, lower, lowest = lowpass[octave : octave + 3]
        band = plane - expanded(lower, *plane.shape)
        around = expanded(expanded(lowest, *lower.shape), *plane.shape)
        bands.append(band / (np.maximum(around, 0.0) + DARK_LIGHT))
    return bands


def oriented(degrees: float) -> tuple[Array, Array]:
    """Return the even and odd 9 x 9 kernels of a direction, each of gain 1 at the band's own.

    The second derivative of a Gaussian, and the polynomial that approximates its Hilbert transform
    (Freeman and Adelson 1991), turned: functions of the place along the direction and across it.
    """
    x = 0.67 * (np.arange(9) - 4)
    gaussian = np.exp(-(x**2))
    wave = np.exp(2j * math.pi * BAND_FREQUENCY * (np.arange(9) - 4))
    even_gain = abs(np.sum((2.0 * x**2 - 1.0) * gaussian * wave)) * gaussian.sum()
    odd_gain = abs(np.sum((x**3 - 2.254 * x) * gaussian * wave)) * gaussian.sum()
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    across, down = np.meshgrid(x, x)
    along = c * across + s * down
    radial = np.exp(-(across**2) - down**2)
    # 2.254 along = 2.254 (c x + s y), of which the separable form rounds each part by itself.
    linear = (2.254 * c**3 + 3.0 * 0.7515 * c * s * s) * across
    linear += (2.254 * s**3 + 3.0 * 0.7515 * s * c * c) * down
    even = (2.0 * along**2 - 1.0) * radial
    odd = (along**3 - linear) * radial
    return even / even_gain, odd / odd_gain


def transfer(weights: Array, frequency: float) -> float:
    """Return what symmetric weights leave of a grating, in cycles/sample."""
    places = np.arange(len(weights)) - len(weights) // 2
    return float(np.sum(weights * np.cos(2.0 * math.pi * frequency * places)))


def sensitivity(octave: int, ppd: float, resample: bool) -> float:
    """Return Barten's sensitivity at a band's frequency over what optics and pyramid leave."""
    frequency = BAND_FREQUENCY * (GRID_PPD if resample else ppd) / 2**octave  # cycles/degree
    passed = transfer(line_spread(ppd), min(frequency / ppd, 0.5))
    for step in range(1, octave + 1):
        passed *= transfer(BURT, BAND_FREQUENCY / 2**step)
    passed *= 1.0 - transfer(BURT, BAND_FREQUENCY) ** 2
    return barten(frequency, ADAPTATION, TARGET) / passed


def disc() -> Array:
    """Return the pooling kernel: a disc 5 samples wide, of sum 1."""
    y, x = np.mgrid[-2:3, -2:3]
    inside = (x**2 + y**2 <= 2.5**2).astype(float)
    return np.asarray(inside / inside.sum())


def pooled(luminance: Array, ppd: float, resample: bool) -> list[list[Array]]:
    """Return the pooled responses of one image: per octave, per orientation."""
    retina = optics(luminance, ppd)
    if resample:
        size = tuple(max(1, round(side * GRID_PPD / ppd)) for side in retina.shape)
        retina = resampled(retina, size, cubic=True)
    responses = []
    for octave, contrast in enumerate(contrasts(retina)):
        weight = sensitivity(octave, ppd, resample)
        orientations = []
        for degrees in (0.0, 45.0, 90.0, 135.0):
            even, odd = oriented(degrees)
            energy = (correlate(contrast, even) ** 2 + correlate(contrast, odd) ** 2) * weight**2
            response = 2.0 * energy ** (2.25 / 2.0) / (energy ** (2.05 / 2.0) + 1.0)
            orientations.append(correlate(response, disc()))
        responses.append(orientations)
    return responses


def jnd_map(test: Array, reference: Array, ppd: float, resample: bool) -> Array:
    """Return the map (H, W), JND, of two luminance planes."""
    total = np.zeros((1, 1))
    pairs = list(zip(pooled(test, ppd, resample), pooled(reference, ppd, resample), strict=True))
    for first, second in reversed(pairs):
        total = expanded(total, *first[0].shape)
        for one, other in zip(first, second, strict=True):
            total = total + np.abs(one - other) ** EXPONENT
    jnd = total ** (1.0 / EXPONENT)
    if resample and jnd.shape != test.shape:
        jnd = resampled(jnd, test.shape, cubic=False)
    return np.asarray(jnd)
