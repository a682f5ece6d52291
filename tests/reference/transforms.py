"""StationaryHaar, Steerable and the filter in NumPy, node by node, as docs/model.md has them.

Planes are (H, W); details are (orientations, h, w), the finest level first. Every node is summed up
by itself, over the pixels or samples that it covers; an image goes on beyond its border as its last
row and column.
"""

import itertools
import math
from functools import cache

import numpy as np

from .calibrated import (
    CalibratedParameters,
    change_ratios,
    cortex_filtering,
    grid_of,
    inherited_share,
    lowpass_term,
    masked_differences,
    own_share,
    sensitivity,
    squared_change,
    sum_down_paths,
    transducer,
)
from .calibrated import nearest as at
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
    local_visual_difference,
    wavelet_peak,
)
from .sarnoff import BURT, correlate, transfer


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


@cache
def diagonal_share() -> float:
    """Return d3's gain over d1's, for a filtered image: all directions as strong over an octave.

    A grating and its like at 45 degrees, on coarse levels; powers of 4, summed over all levels.
    """
    straight = less = diagonal = 0.0
    for place in range(16):
        frequency = 2.0 ** (place / 16 - 5.0)
        for level in range(8):
            gain = wavelet_peak(2**level)[1]
            straight += (haar_responses(level, frequency)[0] / gain) ** 4
            wavelet, window = haar_responses(level, frequency / math.sqrt(2.0))
            less += 2.0 * (wavelet * window / gain) ** 4
            diagonal += (wavelet**2 / gain) ** 4
    return float((diagonal / (straight - less)) ** 0.25)


# The Laplacian pyramid of a filtered image, its lowpass, and that of its finest octave.
SEVEN = np.array([1.0, 6.0, 15.0, 20.0, 15.0, 6.0, 1.0]) / 64.0
THREE = np.array([1.0, 2.0, 1.0]) / 4.0
BANDS = 25


def mirrored(i: int, side: int, reach: int) -> int:
    """Return the place of a sample beyond a border, as a kernel of so many on a side sees it."""
    if side <= reach:
        return min(max(i, 0), side - 1)
    i = abs(i)
    return i if i < side else 2 * (side - 1) - i


def smoothed(plane: Array, kernel: Array) -> Array:
    """Return the correlation with a kernel along rows and columns; borders are mirrored."""
    for _ in range(2):
        reach = len(kernel) // 2
        side = plane.shape[1]
        rows = np.zeros_like(plane)
        for x in range(side):
            for tap, weight in enumerate(kernel):
                rows[:, x] += weight * plane[:, mirrored(x + tap - reach, side, reach)]
        plane = rows.T
    return plane


def between(plane: Array, shape: tuple[int, ...]) -> Array:
    """Return a plane at the next finer size: zeros between its samples, smoothed, times 4."""
    for side in (shape[0], shape[1]):
        finer = np.zeros((side, plane.shape[1]))
        for y in range(side):
            for tap in range(7):
                sample = y + tap - 3
                if sample % 2 == 0:
                    at_sample = mirrored(sample // 2, plane.shape[0], 2)
                    finer[y] += 2.0 * SEVEN[tap] * plane[at_sample]
        plane = finer.T
    return plane


def band_share(band: int, cycles: float) -> float:
    """Return what a band has of a grating, cycles/pixel, by transforming the kernels."""
    parted = transfer(THREE, cycles)
    if band == 0:
        return 1.0 - parted
    passed = parted
    for scale in range(band):
        again = transfer(SEVEN, cycles * 2.0**scale) ** 2 if cycles * 2.0**scale < 0.5 else 0.0
        if scale < band - 1:
            passed *= again
    return passed * (1.0 - again)


def weighted_contrast(image: Array, ppd: float, parameters: CalibratedParameters) -> Array:
    """Return the weighted contrast (3, H, W) of A, C1, C2, the filtered image (3, H, W), XYZ.

    Bands are weighted by what makes gratings of their frequencies pass with their sensitivity, at
    every whole octave of luminance between 2^-8 and 2^17 cd/m2 and linearly between.
    """
    p = parameters
    frequencies = ppd * np.array(
        [0.5, 0.1764, *(0.0775 / 2.0**scale for scale in range(BANDS - 2))]
    )
    shares = [[band_share(band, float(f) / ppd) for band in range(BANDS)] for f in frequencies]
    octaves = np.arange(-8, 18)
    curves = np.array(
        [[sensitivity(float(f), 2.0**octave, p) for octave in octaves] for f in frequencies]
    )
    table = np.einsum("bf,foc->boc", np.linalg.inv(np.array(shares)), curves)
    sml_to_y = np.linalg.inv(XYZ_TO_SML)[1]
    dark = cone_dark_light(p.dark_light)

    here = cone_fundamentals(image)
    scales: list[list[tuple[int, Array]]] = []
    lowpass = []
    for scale in range(level_count(*image.shape[1:])):
        bands = []
        if scale == 0:
            smooth = np.stack([smoothed(cone, THREE) for cone in here])
            bands.append((0, here - smooth))
            here = smooth
        coarse = np.stack([smoothed(cone, SEVEN)[::2, ::2] for cone in here])
        around = np.stack([between(cone, here.shape[1:]) for cone in coarse])
        bands.append((scale + 1, here - around))
        scales.append(bands)
        lowpass.append((coarse, around))
        here = coarse

    total = np.zeros((3, 1, 1))
    for bands, (coarse, around) in zip(reversed(scales), reversed(lowpass), strict=True):
        shape = around.shape[1:]
        whole = np.stack([between(channel, shape) for channel in total])
        for band, plane in bands:
            weights = np.zeros((3, *coarse.shape[1:]))
            for y, x in np.ndindex(coarse.shape[1:]):
                luminance = max(float(sml_to_y @ coarse[:, y, x]), 0.0) + p.dark_light
                for channel in range(3):
                    weights[channel, y, x] = np.interp(
                        math.log2(luminance), octaves, table[band, :, channel]
                    )
            weights = np.stack([between(channel, shape) for channel in weights])
            contrast = plane / (np.maximum(around, 0.0) + dark[:, None, None])
            contrast[0] *= aberration_factor(
                frequencies[band], p.aberration_cutoff, p.aberration_exponent
            )
            whole += weights * np.einsum("ij,jhw->ihw", SML_TO_OPPONENT, contrast)
        total = whole
    return np.broadcast_to(total, image.shape)


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


def weighted_levels(
    image: Array,
    ppd: float,
    kind: str,
    peaks: list[tuple[float, float]],
    parameters: CalibratedParameters,
) -> list[Array]:
    """Return v (orientations, 3, h, w) of every level, the finest first.

    ``peaks`` are frequency, cycles/pixel, and gain of every level, for d3 those of `diagonal_peak`.
    """
    if kind == "filtered":
        planes = [stationary_haar(seen) for seen in weighted_contrast(image, ppd, parameters)]
        responses = []
        for level in range(len(planes[0])):
            weighted = np.stack([channel[level][0] for channel in planes], axis=1)
            weighted /= wavelet_peak(2**level)[1]
            weighted[2] /= diagonal_share()
            responses.append(weighted)
        return responses
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
            if kind == "stationary" and level + 1 < levels:
                # A parent that had its nodes within would have a quarter of the light of each.
                own = np.stack([cone[level][1] for cone in planes])
                top, left = y // 2 * 2, x // 2 * 2
                children = own[:, top : top + 2, left : left + 2]
                light = np.maximum(light, children.max((1, 2)) / 4)
            luminance = max(float(sml_to_y @ light), 0.0) + parameters.dark_light
            contrast = details[:, :, y, x] / (np.maximum(light, 0.0) + dark)
            for orientation in range(len(details)):
                f, g = frequency, gain
                if kind == "stationary" and orientation == 2:
                    f, g = diagonal_peak(level)
                opponent = SML_TO_OPPONENT @ contrast[orientation]
                seen = np.array(sensitivity(ppd * f, luminance, parameters))
                weighted[orientation, :, y, x] = opponent * seen / g
        responses.append(weighted)
    return responses


def pair_differences(
    test: Array,
    reference: Array,
    ppd: float,
    kind: str,
    peaks: list[tuple[float, float]],
    parameters: CalibratedParameters,
) -> list[Array]:
    """Return the squared differences (orientations, 3, h, w) of every level, pooled and masked.

    Of even and odd, their mean.
    """
    first, second = (
        weighted_levels(image, ppd, kind, peaks, parameters) for image in (test, reference)
    )
    levels = []
    for one, other in zip(first, second, strict=True):
        squares = (one - other) ** 2
        if kind == "steerable":
            squares = 0.5 * (squares[0::2] + squares[1::2])
        masks = (one**2 + other**2).sum(axis=0)
        left = np.zeros(squares.shape)
        for orientation, channel in np.ndindex(squares.shape[:2]):
            pooled = box_over_shifts(squares[orientation, channel], 3)
            around = box_over_shifts(masks[channel], 3)
            for y, x in np.ndindex(pooled.shape):
                left[orientation, channel, y, x] = transducer(
                    float(pooled[y, x]), float(around[y, x]), parameters.transducer_exponent
                )
        levels.append(left)
    return levels


def changes_of_halves(
    test: Array, reference: Array, kind: str, peaks: list[tuple[float, float]]
) -> list[Array]:
    """Return c at the halves of nodes of every level, the finest first.

    Of the nodes' own lowpass; behind a filter of the means of their quarters, which the halves are.

    Parameters
    ----------
    test, reference
        Cone images (3, H, W), cd/m2.
    kind, peaks
        As in `weighted_levels`.
    """
    changes = []
    for level in range(level_count(*test.shape[1:])):
        means = []
        for image in (test, reference):
            if kind == "filtered":
                planes = [box_means(cone, 2**level) for cone in image]
            elif kind == "stationary":
                planes = [stationary_haar(cone)[level][1] for cone in image]
            else:
                frequencies = [frequency for frequency, _ in peaks]
                planes = [steerable(cone, frequencies)[level][1] for cone in image]
            means.append(np.stack(planes))
        changes.append(squared_change(*means))
    return changes


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
    cones = [cone_fundamentals(image) for image in (test, reference)]
    one, other = (Pyramid((image,), ()) for image in cones)
    total = np.full((height, width), lowpass_term(one, other, ALL_ON, parameters))
    squares = pair_differences(test, reference, ppd, kind, peaks, parameters)
    changes = changes_of_halves(cones[0], cones[1], kind, peaks)
    for level in reversed(range(len(squares))):
        square = squares[level]
        local = np.zeros(square.shape[2:])
        for orientation, channel in np.ndindex(square.shape[:2]):
            local += square[orientation, channel] ** (0.5 * parameters.summation_exponent)
        ratios = change_ratios(changes[level], 2)
        for y, x in np.ndindex(height, width):
            half = y // 2**level, x // 2**level
            own, inherited = 1.0, 1.0
            if parameters.charging:
                inherited = inherited_share(float(ratios[half]))
                own = own_share(float(ratios[half])) if kind == "filtered" else 1.0
            total[y, x] = own * local[half] + inherited * total[y, x]
    return np.asarray(total ** (1.0 / parameters.summation_exponent))


def changes_of_quarters(test: Array, reference: Array) -> list[Array]:
    """Return c of the nodes of `Haar` behind a filter, from the root to those of 2 pixels.

    The mean over the quarters that a node has of c of their means: a quarter is a node of the next
    finer level, or a pixel. ``test``, ``reference``: cone images (3, H, W), cd/m2.
    """
    grid = grid_of(*test.shape[1:])[::-1]
    changes = []
    for (y_row, x_row), (y_finer, x_finer) in itertools.pairwise(grid):
        change = np.zeros((y_row.nodes(), x_row.nodes()))
        for n, m in np.ndindex(change.shape):
            rows, columns = (
                sorted({finer.at(pixel) for pixel in row.pixels(node)})
                for row, finer, node in ((y_row, y_finer, n), (x_row, x_finer, m))
            )
            of_quarters = []
            for y, x in itertools.product(rows, columns):
                down, across = y_finer.pixels(y), x_finer.pixels(x)
                part = slice(None), slice(down[0], down[-1] + 1), slice(across[0], across[-1] + 1)
                means = [image[part].mean((1, 2)) for image in (test, reference)]
                of_quarters.append(float(((means[0] - means[1]) ** 2).sum()))
            change[n, m] = np.mean(of_quarters)
        changes.append(change)
    return changes


def filtered_haar_map(
    test: Array, reference: Array, ppd: float, parameters: CalibratedParameters
) -> Array:
    """Return the map (H, W), JND, of `Haar` behind a filter; images (3, H, W), XYZ in cd/m2."""
    responses = []
    for image in (test, reference):
        details = cortex_filtering(weighted_contrast(image, ppd, parameters)).details
        levels = []
        for level, plane in enumerate(details):
            finer = len(details) - 1 - level
            weighted = plane / wavelet_peak(2**finer)[1]
            weighted[2] /= diagonal_share()
            levels.append(weighted)
        responses.append(levels)
    lvd = tuple(
        local_visual_difference(
            np.sqrt(masked_differences(one, other, ALL_ON, parameters)),
            parameters.summation_exponent,
        )
        for one, other in zip(*responses, strict=True)
    )
    cones = cone_fundamentals(test), cone_fundamentals(reference)
    ratios = None
    if parameters.charging:
        ratios = [change_ratios(change) for change in changes_of_quarters(*cones)]
    first, second = (Pyramid((image,), ()) for image in cones)
    root = lowpass_term(first, second, ALL_ON, parameters)
    _, height, width = test.shape
    total = sum_down_paths(lvd, root, height, width, ratios, filtered=True)
    return np.asarray(total ** (1.0 / parameters.summation_exponent))
