"""The calibrated observer: the pipeline of ``paper`` with other stages where data asked for them.

What is not here is the paper's own, imported: Eq. 1 to 3, the wavelet's frequencies, the shape of
the aberration, local contrast, the Butterworth filter, the 3x3 box, Eq. 5 and the
path sums. All numbers are arguments. Shapes, orders and units as in ``paper``.
"""

import math
from dataclasses import dataclass

import numpy as np

from .paper import (
    ALL_ON,
    XYZ_TO_SML,
    Array,
    Effects,
    Pyramid,
    butterworth,
    chromatic_aberration,
    cone_dark_light,
    cone_fundamentals,
    haar_step,
    half_width,
    level_count,
    level_frequency,
    local_contrast,
    local_visual_difference,
    opponents,
    parent_lowpass,
    spatial_pooling,
    sum_down_paths,
    wavelet_peak,
)


@dataclass(frozen=True)
class CalibratedParameters:
    """All numbers of the calibrated observer. Status: fitted or choice, by whoever passes them.

    Attributes
    ----------
    dark_light
        The eye's dark light, cd/m2.
    aberration_cutoff, aberration_exponent
        Of exp(-(f/cutoff)^exponent); cycles/degree and no unit.
    achromatic_gain
        Sensitivity of A at its peak, 1/contrast.
    dim_luminance, achromatic_dimming, chromatic_dimming
        L0, cd/m2, and p, no unit, of (1 + L0/Lum)^(-p), for A and for C1 and C2.
    glare_luminance, glare_exponent
        Lg, cd/m2, and p, no unit, of (1 + Lum/Lg)^(-p) for A.
    peak_frequency, peak_luminance, peak_exponent
        f0, cycles/degree, L1, cd/m2, and r, no unit, of A's peak f0 (1 + L1/Lum)^(-r).
    band_width, band_floor
        w, octaves, and what is left far below the peak, no unit.
    red_green_gain, red_green_cutoff, red_green_order
        Butterworth sensitivity of C1 at 0 cycles/degree, 1/contrast; fc, cycles/degree; n.
    yellow_violet_gain, yellow_violet_cutoff, yellow_violet_order
        The same for C2.
    transducer_exponent
        q of the signed transducer; no unit.
    summation_exponent
        In the place of Eq. 5's 2.4; no unit.
    lowpass_gains
        Sensitivity of A, C1, C2 to the root lowpass, 1/contrast.
    score_exponent, score_coefficients, score_window
        Of the detection score; the window in nodes.
    """

    dark_light: float
    aberration_cutoff: float
    aberration_exponent: float
    achromatic_gain: float
    dim_luminance: float
    achromatic_dimming: float
    chromatic_dimming: float
    glare_luminance: float
    glare_exponent: float
    peak_frequency: float
    peak_luminance: float
    peak_exponent: float
    band_width: float
    band_floor: float
    red_green_gain: float
    red_green_cutoff: float
    red_green_order: float
    yellow_violet_gain: float
    yellow_violet_cutoff: float
    yellow_violet_order: float
    transducer_exponent: float
    summation_exponent: float
    lowpass_gains: tuple[float, float, float]
    score_exponent: float
    score_coefficients: float
    score_window: int


@dataclass(frozen=True)
class SignedResponses:
    """What each stage from local contrast to the transducer returns, one array a level.

    Pooling follows on the difference of two images, in `compare`.

    Attributes
    ----------
    contrast
        Cone contrasts (3, 3, h, w) over orientation and cone; no unit.
    opponent
        Opponent contrasts (3, C, h, w), C = 1 without the chromatic channels; no unit.
    luminance
        Local luminance (h, w), cd/m2.
    weighted
        v, contrast times sensitivity over the level's gain (3, C, h, w), signed; 1 at threshold.
    response
        psi(v) (3, C, h, w), signed; 1 at threshold.
    """

    contrast: tuple[Array, ...]
    opponent: tuple[Array, ...]
    luminance: tuple[Array, ...]
    weighted: tuple[Array, ...]
    response: tuple[Array, ...]


# Cortex filtering


def block(n: int, node: int, side: int) -> slice:
    """Pixels of node ``n`` of an axis of ``side`` pixels, ``node`` pixels to a node."""
    return slice(n * node, min((n + 1) * node, side))


def border_window(plane: Array, node: int, side: int) -> Array:
    """Make the number of columns of ``plane`` even, and the last detail that of real pixels.

    The last column R has b of its a = ``node`` pixels, and the one before it, L, has all. The
    pixels that R lacks are taken to be like L. Then, with

    - an even number of columns: nothing more, L is its sibling;
    - an odd number: R has no sibling, and L is its partner;
    - one column: repeated.

    Parameters
    ----------
    plane
        Lowpass (h, w) of one cone.
    node, side
        Pixels in a whole column of ``plane``, and in the image's row.
    """
    width = plane.shape[1]
    if width == 1:
        return np.concatenate((plane, plane), axis=1)
    pixels = block(width - 1, node, side)
    b = pixels.stop - pixels.start
    columns = [plane[:, x].copy() for x in range(width)]
    columns[-1] = ((node - b) * columns[-2] + b * columns[-1]) / node
    if width % 2 == 1:
        columns.append(columns[-2])
    return np.stack(columns, axis=1)


def cortex_filtering(sml: Array) -> Pyramid:
    """Eq. 2 from the pixels to the root, where every pixel has the same weight.

    The lowpass of a node is the mean of the pixels that it has.

    Parameters
    ----------
    sml
        S, M, L (3, H, W), cd/m2.
    """
    _, rows, columns = sml.shape
    lowpass = [sml]
    details: list[Array] = []
    for up in range(level_count(rows, columns)):
        node = 2**up
        step = []
        for plane in lowpass[0]:
            window = border_window(border_window(plane.T, node, rows).T, node, columns)
            step.append(haar_step(window)[1])
        details.insert(0, np.stack(step, axis=1))
        means = np.zeros((3, *details[0].shape[-2:]))
        for cone, y, x in np.ndindex(means.shape):
            means[cone, y, x] = sml[
                cone, block(y, 2 * node, rows), block(x, 2 * node, columns)
            ].mean()
        lowpass.insert(0, means)
    return Pyramid(tuple(lowpass), tuple(details))


# CSF filtering


def local_luminance(pyramid: Pyramid, level: int, dark_light: float) -> Array:
    """Luminance to which every node is adapted, max(Y of the parent's lowpass, 0) + dark light.

    Y comes from S, M, L by the inverse of Eq. 1; the root uses its own lowpass.

    Parameters
    ----------
    pyramid
        Representation of one image, cd/m2.
    level
        0 for the root.
    dark_light
        cd/m2.

    Returns
    -------
    Array
        (h, w), cd/m2.
    """
    sml_to_y = np.linalg.inv(XYZ_TO_SML)[1]
    lowpass = parent_lowpass(pyramid, level)
    _, height, width = lowpass.shape
    luminance = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            y_of_node = sum(sml_to_y[cone] * lowpass[cone, y, x] for cone in range(3))
            luminance[y, x] = max(y_of_node, 0.0) + dark_light
    return luminance


def luminance_gain(luminance: float, knee: float, exponent: float) -> float:
    """Part of a sensitivity left at ``luminance``, (1 + knee/luminance)^(-exponent).

    Parameters
    ----------
    luminance
        Lum, cd/m2, above 0.
    knee
        L0, cd/m2.
    exponent
        p, no unit.
    """
    return float((1 + knee / luminance) ** -exponent)


def band(octaves: float, width: float, floor: float) -> float:
    """Shape of A's sensitivity ``octaves`` above its peak, 1 at the peak.

    exp(-(abs(octaves)/width)^1.5); below the peak ``floor`` + (1 - ``floor``) times it.
    """
    falling = math.exp(-((abs(octaves) / width) ** 1.5))
    return falling if octaves > 0 else floor + (1 - floor) * falling


def sensitivity(
    f: float, luminance: float, parameters: CalibratedParameters
) -> tuple[float, float, float]:
    """Contrast sensitivity of A, C1, C2, 1/contrast, local in luminance.

    Parameters
    ----------
    f
        Cycles/degree.
    luminance
        Lum, cd/m2, above 0.
    parameters
        The observer's numbers.
    """
    p = parameters
    peak = p.peak_frequency * luminance_gain(luminance, p.peak_luminance, p.peak_exponent)
    bright = (
        luminance_gain(luminance, p.dim_luminance, p.achromatic_dimming)
        * (1 + luminance / p.glare_luminance) ** -p.glare_exponent
    )
    dim = luminance_gain(luminance, p.dim_luminance, p.chromatic_dimming)
    return (
        p.achromatic_gain * bright * band(math.log2(f / peak), p.band_width, p.band_floor),
        butterworth(f, p.red_green_gain, p.red_green_cutoff, p.red_green_order) * dim,
        butterworth(f, p.yellow_violet_gain, p.yellow_violet_cutoff, p.yellow_violet_order) * dim,
    )


def csf_filtering(
    opponent: Array, f: float, peak_gain: float, luminance: Array, parameters: CalibratedParameters
) -> Array:
    """Weighted contrast of one level, v = contrast x sensitivity / peak gain of its wavelet.

    Parameters
    ----------
    opponent
        (3, C, h, w) over orientation and channel, signed; no unit.
    f
        The level's frequency, cycles/degree.
    peak_gain
        Magnitude response of the level's wavelet at ``f``; no unit.
    luminance
        Local luminance (h, w), cd/m2.
    parameters
        The observer's numbers.

    Returns
    -------
    Array
        v, (3, C, h, w), signed; 1 at threshold.
    """
    weighted = np.zeros(opponent.shape)
    _, channels, height, width = opponent.shape
    for y in range(height):
        for x in range(width):
            gains = sensitivity(f, luminance[y, x], parameters)
            for theta in range(3):
                for channel in range(channels):
                    weighted[theta, channel, y, x] = (
                        opponent[theta, channel, y, x] * gains[channel] / peak_gain
                    )
    return weighted


# Masking transducer


def transducer(v: float, exponent: float) -> float:
    """Signed, for Eq. 4: psi(v) = 2^q v (1 + v^2)^(-q), q = ``exponent``; psi(1) = 1."""
    return float(2**exponent * v * (1 + v**2) ** -exponent)


def masking_transducer(
    weighted: Array, effects: Effects, parameters: CalibratedParameters
) -> Array:
    """Transducer psi on one level (3, C, h, w), signed, 1 at threshold.

    Parameters
    ----------
    weighted
        v, (3, C, h, w), signed; 1 at threshold.
    effects
        Without ``masking`` the identity.
    parameters
        The observer's numbers.
    """
    if not effects.masking:
        return weighted
    response = np.zeros(weighted.shape)
    for at in np.ndindex(weighted.shape):
        response[at] = transducer(float(weighted[at]), parameters.transducer_exponent)
    return response


# Distance summation


def lowpass_contrast(test: Array, reference: Array, dark_light: float) -> Array:
    """Weber contrast between two root lowpass nodes.

    w_j = (c1_j - c2_j) / ((max(c1_j, 0) + max(c2_j, 0)) / 2 + dark_j) for j = S, M, L.

    Parameters
    ----------
    test, reference
        S, M, L (3,), cd/m2.
    dark_light
        cd/m2.

    Returns
    -------
    Array
        S, M, L (3,), signed; no unit.
    """
    dark = cone_dark_light(dark_light)
    contrast = np.zeros(3)
    for cone in range(3):
        mean = (max(test[cone], 0.0) + max(reference[cone], 0.0)) / 2
        contrast[cone] = (test[cone] - reference[cone]) / (mean + dark[cone])
    return contrast


def lowpass_term(
    test: Pyramid, reference: Pyramid, effects: Effects, parameters: CalibratedParameters
) -> float:
    """Term of the coarsest lowpass in every leaf's sum, which the paper leaves out.

    Parameters
    ----------
    test, reference
        Representations of the two images, cd/m2.
    effects
        Without ``chromatic`` channel A only; the other switches change nothing here.
    parameters
        The observer's numbers.

    Returns
    -------
    float
        JND to the power ``summation_exponent``.
    """
    # The last lowpass is the cone image.
    contrast = lowpass_contrast(
        test.lowpass[-1].mean((1, 2)), reference.lowpass[-1].mean((1, 2)), parameters.dark_light
    )
    opponent = opponents(contrast[None, :, None, None], effects)[0, :, 0, 0]
    term = 0.0
    for channel, value in enumerate(opponent):
        term += abs(parameters.lowpass_gains[channel] * value) ** parameters.summation_exponent
    return float(term)


# The whole, in the order of Fig. 2


def represent(
    xyz: Array, ppd: float, parameters: CalibratedParameters, effects: Effects = ALL_ON
) -> Pyramid:
    """Cone fundamentals to chromatic aberration (Fig. 2) of one image (3, H, W), XYZ in cd/m2."""
    return chromatic_aberration(
        cortex_filtering(cone_fundamentals(xyz)),
        ppd,
        effects,
        parameters.aberration_cutoff,
        parameters.aberration_exponent,
    )


def respond(
    pyramid: Pyramid, ppd: float, parameters: CalibratedParameters, effects: Effects = ALL_ON
) -> SignedResponses:
    """Local contrast to masking transducer (Fig. 2) of one image's representation."""
    levels = len(pyramid.details)
    dark_light = parameters.dark_light
    contrast = tuple(local_contrast(pyramid, level, dark_light) for level in range(levels))
    opponent = tuple(opponents(plane, effects) for plane in contrast)
    luminance = tuple(local_luminance(pyramid, level, dark_light) for level in range(levels))
    weighted = []
    for level in range(levels):
        f = level_frequency(level, levels, ppd)
        _, peak_gain = wavelet_peak(half_width(level, levels))
        weighted.append(csf_filtering(opponent[level], f, peak_gain, luminance[level], parameters))
    response = tuple(masking_transducer(plane, effects, parameters) for plane in weighted)
    return SignedResponses(contrast, opponent, luminance, tuple(weighted), response)


def compare(
    test: SignedResponses,
    reference: SignedResponses,
    parameters: CalibratedParameters,
    effects: Effects = ALL_ON,
) -> tuple[Array, ...]:
    """Spatial pooling of abs(R_1 - R_2), then Eq. 5: the LVD of every node, one (h, w) a level.

    The magnitude is pooled because signed responses of neighbours alternate and would cancel.

    Returns
    -------
    tuple of Array
        JND to the power ``summation_exponent``.
    """
    return tuple(
        local_visual_difference(
            spatial_pooling(np.abs(r1 - r2), effects), parameters.summation_exponent
        )
        for r1, r2 in zip(test.response, reference.response, strict=True)
    )


def jnd_map(
    test_xyz: Array,
    reference_xyz: Array,
    ppd: float,
    parameters: CalibratedParameters,
    effects: Effects = ALL_ON,
) -> Array:
    """Visual difference map of the calibrated observer.

    Parameters
    ----------
    test_xyz, reference_xyz
        CIE XYZ (3, H, W), cd/m2, of the same shape.
    ppd
        Pixels/degree.
    parameters
        The observer's numbers.
    effects
        The stages that are on.

    Returns
    -------
    Array
        (H, W), JND.
    """
    test = represent(test_xyz, ppd, parameters, effects)
    reference = represent(reference_xyz, ppd, parameters, effects)
    lvd = compare(
        respond(test, ppd, parameters, effects),
        respond(reference, ppd, parameters, effects),
        parameters,
        effects,
    )
    _, height, width = test_xyz.shape
    total = sum_down_paths(lvd, height, width)
    total += lowpass_term(test, reference, effects, parameters)
    return np.asarray(total ** (1 / parameters.summation_exponent))


def glance_weight(offset: float, window: int) -> float:
    """Weight of a node ``offset`` nodes from the middle of a glance, along one axis."""
    return max(0.0, 1 - abs(offset) / window)


def detection_score(
    test_xyz: Array, reference_xyz: Array, ppd: float, parameters: CalibratedParameters
) -> float:
    """Detection score of an image as one stimulus, JND; arguments as in `jnd_map`.

    Around every node of a level the powers of the response differences are summed, with weights
    that fall linearly over ``score_window`` nodes; these sums are added down the paths of the
    quad-tree, and the leaf with the largest total tells.
    """
    p = parameters
    test = represent(test_xyz, ppd, p)
    reference = represent(reference_xyz, ppd, p)
    r1 = respond(test, ppd, p).response
    r2 = respond(reference, ppd, p).response
    glances = []
    for one, other in zip(r1, r2, strict=True):
        power = (np.abs(one - other) ** p.score_exponent).sum((0, 1))
        height, width = power.shape
        total = np.zeros((height, width))
        for y, x in np.ndindex(height, width):
            for v, u in np.ndindex(height, width):
                weight = glance_weight(y - v, p.score_window) * glance_weight(x - u, p.score_window)
                total[y, x] += weight * power[v, u]
        glances.append(total)
    _, height, width = test_xyz.shape
    leaves = sum_down_paths(tuple(glances), height, width)
    contrast = lowpass_contrast(
        test.lowpass[-1].mean((1, 2)), reference.lowpass[-1].mean((1, 2)), p.dark_light
    )
    opponent = opponents(contrast[None, :, None, None], ALL_ON)[0, :, 0, 0]
    lowpass = sum(
        abs(gain * value) ** p.score_exponent
        for gain, value in zip(p.lowpass_gains, opponent, strict=True)
    )
    return float((leaves.max() / p.score_coefficients + lowpass) ** (1 / p.score_exponent))
