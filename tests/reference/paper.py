"""The paper's observer, to be held beside the paper.

M. R. Bolin and G. W. Meyer, "A Visual Difference Metric for Realistic Image Synthesis" (1999),
section 2; the functions stand in the order of the boxes of Fig. 2. docs/model.md is the project's
list of what the paper leaves open.

An image is an array (3, H, W) of absolute CIE XYZ in cd/m2. Cones are in the order S, M, L,
opponent channels A, C1, C2, orientations d1 (horizontal), d2 (vertical), d3 (diagonal). Planes are
indexed ``[y, x]``, the details of a level and all that follows from them are indexed
``[theta, channel, y, x]``, as P[theta, c] in Eq. 5. A sequence over levels begins with the root:
level 0 has a single node.
"""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

XYZ_TO_SML: Array = np.array(
    [
        [0.0000, 0.0000, 0.5609],
        [-0.4227, 1.1723, 0.0911],
        [0.1150, 0.9364, -0.0203],
    ]
)
"""Cone fundamentals; no unit. Source: Eq. 1 (Meyer 1988). Status: printed."""

SML_TO_OPPONENT: Array = np.array(
    [
        [0.0001, 0.2499, 0.7647],
        [0.0018, 2.9468, -2.5336],
        [1.0111, -0.3877, 0.2670],
    ]
)
"""Opponents contrast space; no unit. Source: Eq. 3 (Meyer 1988). Status: printed."""

ABERRATION_CUTOFF = 4.4
"""Frequency at which the S cones keep 1/e, cycles/degree. Source: the text on Fig. 4 (below half at
4 cpd, almost nothing above 8 cpd). Status: fitted."""

ABERRATION_EXPONENT = 2.0
"""Exponent of the aberration's exponential; no unit. Source: the text on Fig. 4. Status:
fitted."""

DARK_LIGHT = 1e-4
"""Luminance added to every lowpass, cd/m2, so that a division by 0 stays finite. Status: choice."""

BARTEN_C = 0.06
"""c of Barten's formula; no unit. Source: Barten 1989 (reference 1). Status: source."""

ADAPTATION_LUMINANCE = 100.0
"""L of Barten's formula, one constant of the observer, cd/m2. Status: choice."""

ACHROMATIC_SIZE = 12.0
"""w of Barten's formula, a constant and never the image's size, degrees. Status: choice."""

RED_GREEN_GAIN = 76.0
"""Butterworth S0 of C1, 1/contrast. Source: human thresholds (docs/model.md). Status: fitted."""

YELLOW_VIOLET_GAIN = 36.0
"""Butterworth S0 of C2, 1/contrast. Source: human thresholds (docs/model.md). Status: fitted."""

CHROMATIC_CUTOFF = 2.29
"""Butterworth fc of C1 and C2, cycles/degree. Source: human thresholds (docs/model.md). Status:
fitted."""

CHROMATIC_ORDER = 1.09
"""Butterworth n of C1 and C2; no unit. Source: human thresholds (docs/model.md). Status: fitted."""

TRANSDUCER_GAIN = 2.0
TRANSDUCER_NUMERATOR = 2.25 / 2
TRANSDUCER_DENOMINATOR = 2.05 / 2
"""Factor and exponents of the transducer; no unit. Source: Eq. 4. Status: printed."""

POOLING_WIDTH = 3
"""Side of the pooling filter, nodes. Source: Fig. 6 and its text. Status: printed (its equal
weights and the replicated border are a choice)."""

SUMMATION_EXPONENT = 2.4
"""Exponent of the vector sum; no unit. Source: Eq. 5 (Quick 1974). Status: printed."""


@dataclass(frozen=True)
class Effects:
    """Stages of Fig. 2 that can be switched off, each by the rule of its own function.

    Attributes
    ----------
    aberration
        Off: the S details keep the factor 1.
    chromatic
        Off: channel A only.
    masking
        Off: the response is the weighted contrast itself (here its magnitude, the root of the
        energy).
    pooling
        Off: the identity.
    """

    aberration: bool = True
    chromatic: bool = True
    masking: bool = True
    pooling: bool = True


ALL_ON = Effects()


@dataclass(frozen=True)
class Pyramid:
    """Haar decomposition of one image (Eq. 2 on each cone plane).

    Attributes
    ----------
    lowpass
        c_l of every detail level l, each (3, h, w) over S, M, L, cd/m2; after them the cone image
        itself (3, H, W), so there is one entry more than in ``details``.
    details
        d_l of every detail level l, each (3, 3, h, w) over orientation and cone, cd/m2; none for
        1x1.
    """

    lowpass: tuple[Array, ...]
    details: tuple[Array, ...]


AnyPyramid = TypeVar("AnyPyramid", bound=Pyramid)


@dataclass(frozen=True)
class Responses:
    """What each stage from local contrast to spatial pooling returns, one (3, C, h, w) a level.

    C is 3 (cones S, M, L, or channels A, C1, C2), but 1 from ``opponent`` on without the chromatic
    channels.

    Attributes
    ----------
    contrast
        Cone contrasts; no unit.
    opponent
        Opponent contrasts; no unit.
    energy
        Square of contrast times sensitivity; 1 at threshold.
    response
        Output of the transducer; 1 at threshold.
    pooled
        P of Eq. 5; the response averaged over 3x3 nodes.
    """

    contrast: tuple[Array, ...]
    opponent: tuple[Array, ...]
    energy: tuple[Array, ...]
    response: tuple[Array, ...]
    pooled: tuple[Array, ...]


# Cone fundamentals


def cone_fundamentals(xyz: Array) -> Array:
    """Eq. 1: cone responses of every pixel.

    Parameters
    ----------
    xyz
        CIE XYZ (3, H, W), cd/m2.

    Returns
    -------
    Array
        S, M, L (3, H, W), cd/m2.
    """
    _, height, width = xyz.shape
    sml = np.zeros((3, height, width))
    for y in range(height):
        for x in range(width):
            for cone in range(3):
                for k in range(3):
                    sml[cone, y, x] += XYZ_TO_SML[cone, k] * xyz[k, y, x]
    return sml


# Cortex filtering


def level_count(height: int, width: int) -> int:
    """Count the detail levels, ceil(log2(longer side)); 0 for 1x1.

    The paper's *levels* also counts the pixels, which are its c_(levels-1) and our c_levels.
    """
    count = 0
    while 2**count < max(height, width):
        count += 1
    return count


def pad_to_even(plane: Array) -> Array:
    """Repeat the last column and row of a plane (h, w) where its side is odd. Status: choice."""
    height, width = plane.shape
    padded = np.zeros((height + height % 2, width + width % 2))
    for y in range(padded.shape[0]):
        for x in range(padded.shape[1]):
            padded[y, x] = plane[min(y, height - 1), min(x, width - 1)]
    return padded


def haar_step(c: Array) -> tuple[Array, Array]:
    """Eq. 2: one level of the two-dimensional non-standard Haar decomposition.

    Parameters
    ----------
    c
        Lowpass c_l (h, w) of one cone, cd/m2, both sides even.

    Returns
    -------
    lowpass : Array
        c_(l-1), (h/2, w/2), cd/m2.
    details : Array
        d1, d2, d3 of level l-1, (3, h/2, w/2), cd/m2.
    """
    height, width = c.shape
    lowpass = np.zeros((height // 2, width // 2))
    details = np.zeros((3, height // 2, width // 2))
    for y in range(0, height, 2):
        for x in range(0, width, 2):
            at = (y // 2, x // 2)
            lowpass[at] = (c[y, x] + c[y, x + 1] + c[y + 1, x] + c[y + 1, x + 1]) / 4
            details[0][at] = (c[y, x] - c[y, x + 1] + c[y + 1, x] - c[y + 1, x + 1]) / 4
            details[1][at] = (c[y, x] + c[y, x + 1] - c[y + 1, x] - c[y + 1, x + 1]) / 4
            details[2][at] = (c[y, x] - c[y, x + 1] - c[y + 1, x] + c[y + 1, x + 1]) / 4
    return lowpass, details


def cortex_filtering(sml: Array) -> Pyramid:
    """Eq. 2 from the pixels to the root, on each cone plane.

    Parameters
    ----------
    sml
        S, M, L (3, H, W), cd/m2.

    Returns
    -------
    Pyramid
        Its planes have ceil(n/2) nodes a side for n in the level below, down to the root's 1x1.
    """
    lowpass = [sml]
    details: list[Array] = []
    for _ in range(level_count(sml.shape[1], sml.shape[2])):
        steps = [haar_step(pad_to_even(plane)) for plane in lowpass[0]]
        lowpass.insert(0, np.stack([c for c, _ in steps]))
        details.insert(0, np.stack([d for _, d in steps], axis=1))
    return Pyramid(tuple(lowpass), tuple(details))


@cache
def wavelet_peak(m: int) -> tuple[float, float]:
    """Optimum of the one-dimensional Haar wavelet of 2m pixels, found from its DTFT.

    The wavelet is the mean of m pixels minus the mean of the next m, halved, as in Eq. 2. A grid
    finds the highest point of its magnitude response on (0, pi], bisection of the slope there the
    exact place (to a few units in the last place: the magnitude itself is flat at its maximum).

    Parameters
    ----------
    m
        Half the wavelet's width, pixels: 1 at the finest level, doubling at each coarser one.

    Returns
    -------
    frequency : float
        radians/pixel, in (0, pi].
    gain : float
        Magnitude response there; no unit.
    """
    wavelet = np.array([1.0] * m + [-1.0] * m) / (2 * m)
    position = np.arange(2 * m) - (2 * m - 1) / 2  # from the centre, pixels: changes the phase only

    def magnitude(w: float) -> float:
        return float(abs(np.sum(wavelet * np.exp(-1j * w * position))))

    def slope(w: float) -> float:
        # of half the squared magnitude
        transform = np.sum(wavelet * np.exp(-1j * w * position))
        derivative = np.sum(-1j * position * wavelet * np.exp(-1j * w * position))
        return float((transform.conjugate() * derivative).real)

    points = 16 * m  # 32 of them on the main lobe, which is 2 pi / m wide
    best = max(range(1, points + 1), key=lambda i: magnitude(math.pi * i / points))
    below = math.pi * (best - 1) / points
    above = math.pi * min(best + 1, points) / points
    for _ in range(60):
        middle = (below + above) / 2
        if slope(middle) > 0:
            below = middle
        else:
            above = middle
    return above, magnitude(above)


def half_width(level: int, levels: int) -> int:
    """Half the width of the wavelet of ``level``, pixels: 1 at the finest of ``levels`` levels."""
    return int(2 ** (levels - 1 - level))


def level_frequency(level: int, levels: int, ppd: float) -> float:
    """Frequency to which the wavelet of a level is "optimally responsive" (section 2, on Fig. 3).

    Parameters
    ----------
    level, levels
        The level, 0 for the root, and the number of detail levels.
    ppd
        Pixels/degree.

    Returns
    -------
    float
        Cycles/degree, at most ppd/2.
    """
    frequency, _ = wavelet_peak(half_width(level, levels))
    return ppd * (frequency / (2 * math.pi))


# Chromatic aberration


def aberration_factor(f: float, cutoff: float, exponent: float) -> float:
    """Fig. 4: what the eye's optics leave of the S cones' detail, exp(-(f/cutoff)^exponent).

    Parameters
    ----------
    f
        Cycles/degree.
    cutoff
        Cycles/degree.
    exponent
        No unit.
    """
    return math.exp(-((f / cutoff) ** exponent))


def chromatic_aberration(
    pyramid: AnyPyramid,
    ppd: float,
    effects: Effects,
    cutoff: float = ABERRATION_CUTOFF,
    exponent: float = ABERRATION_EXPONENT,
) -> AnyPyramid:
    """Fig. 4: attenuate the S details of every level; M, L and all lowpass stay.

    Parameters
    ----------
    pyramid
        The cortex representation, cd/m2.
    ppd
        Pixels/degree.
    effects
        Without ``aberration`` the factor is 1.
    cutoff, exponent
        Of `aberration_factor`; cycles/degree and no unit.
    """
    if not effects.aberration:
        return pyramid
    levels = len(pyramid.details)
    attenuated = []
    for level, details in enumerate(pyramid.details):
        factor = aberration_factor(level_frequency(level, levels, ppd), cutoff, exponent)
        attenuated.append(details * np.array([factor, 1.0, 1.0])[None, :, None, None])
    return replace(pyramid, details=tuple(attenuated))


# Local contrast


def cone_dark_light(dark_light: float) -> Array:
    """Cone responses to an equal-energy light of luminance ``dark_light``. Status: choice.

    Parameters
    ----------
    dark_light
        cd/m2.

    Returns
    -------
    Array
        S, M, L (3,), cd/m2: ``dark_light`` times the row sums of Eq. 1's matrix.
    """
    return cone_fundamentals(np.full((3, 1, 1), dark_light))[:, 0, 0]


def parent_lowpass(pyramid: Pyramid, level: int) -> Array:
    """Lowpass "one level up in the quad-tree" of every node of a level (section 2, local contrast).

    The parent of node (x, y) is (x//2, y//2); the root, which has none, uses its own.

    Returns
    -------
    Array
        (3, h, w) over S, M, L, cd/m2, h and w those of ``level``.
    """
    own = pyramid.lowpass[level]
    if level == 0:
        return own
    above = pyramid.lowpass[level - 1]
    parent = np.zeros(own.shape)
    for y in range(own.shape[1]):
        for x in range(own.shape[2]):
            parent[:, y, x] = above[:, y // 2, x // 2]
    return parent


def local_contrast(pyramid: Pyramid, level: int, dark_light: float = DARK_LIGHT) -> Array:
    """Cone contrasts dS/S, dM/M, dL/L of one level (section 2, local contrast).

    Parameters
    ----------
    pyramid
        The representation after chromatic aberration, cd/m2.
    level
        0 for the root.
    dark_light
        cd/m2.

    Returns
    -------
    Array
        (3, 3, h, w) over orientation and cone; no unit.
    """
    details = pyramid.details[level]
    lowpass = parent_lowpass(pyramid, level)
    dark = cone_dark_light(dark_light)
    contrast = np.zeros(details.shape)
    for theta, cone, y, x in np.ndindex(details.shape):
        light = max(float(lowpass[cone, y, x]), 0.0) + dark[cone]
        contrast[theta, cone, y, x] = details[theta, cone, y, x] / light
    return contrast


# Opponents contrast space


def opponents(contrast: Array, effects: Effects) -> Array:
    """Eq. 3: opponent contrasts of one level.

    Parameters
    ----------
    contrast
        Cone contrasts (3, 3, h, w) over orientation and cone; no unit.
    effects
        Without ``chromatic`` only A is returned.

    Returns
    -------
    Array
        (3, C, h, w) over orientation and channel A, C1, C2 (C = 3) or A (C = 1); no unit.
    """
    orientations, _, height, width = contrast.shape
    opponent = np.zeros((orientations, 3 if effects.chromatic else 1, height, width))
    for theta, channel, y, x in np.ndindex(opponent.shape):
        for cone in range(3):
            opponent[theta, channel, y, x] += (
                SML_TO_OPPONENT[channel, cone] * contrast[theta, cone, y, x]
            )
    return opponent


# CSF filtering


def barten(u: float, luminance: float, size: float) -> float:
    """Achromatic contrast sensitivity, 1/contrast (Barten 1989, the form with size).

    Parameters
    ----------
    u
        Cycles/degree.
    luminance
        L, cd/m2, above 0.
    size
        w, degrees.
    """
    a = 540 * (1 + 0.7 / luminance) ** -0.2 / (1 + 12 / (size * (1 + u / 3) ** 2))
    b = 0.3 * (1 + 100 / luminance) ** 0.15
    return float(a * u * math.exp(-b * u) * math.sqrt(1 + BARTEN_C * math.exp(b * u)))


def butterworth(f: float, gain: float, cutoff: float, order: float) -> float:
    """Chromatic contrast sensitivity gain / sqrt(1 + (f/cutoff)^(2 order)), 1/contrast (Fig. 5).

    Parameters
    ----------
    f
        Cycles/degree.
    gain
        1/contrast, at 0 cycles/degree.
    cutoff
        Cycles/degree.
    order
        No unit.
    """
    return gain / math.sqrt(1 + (f / cutoff) ** (2 * order))


def sensitivity(f: float) -> tuple[float, float, float]:
    """Contrast sensitivity of A, C1, C2 at ``f`` cycles/degree, 1/contrast (Fig. 5)."""
    return (
        barten(f, ADAPTATION_LUMINANCE, ACHROMATIC_SIZE),
        butterworth(f, RED_GREEN_GAIN, CHROMATIC_CUTOFF, CHROMATIC_ORDER),
        butterworth(f, YELLOW_VIOLET_GAIN, CHROMATIC_CUTOFF, CHROMATIC_ORDER),
    )


def csf_filtering(opponent: Array, f: float) -> Array:
    """Energy of one level: contrast squared times sensitivity squared (section 2, on Fig. 5).

    Parameters
    ----------
    opponent
        (3, C, h, w) over orientation and channel; no unit.
    f
        The level's frequency, cycles/degree.

    Returns
    -------
    Array
        (3, C, h, w), 1 at threshold.
    """
    gains = sensitivity(f)
    energy = np.zeros(opponent.shape)
    for theta, channel, y, x in np.ndindex(opponent.shape):
        energy[theta, channel, y, x] = opponent[theta, channel, y, x] ** 2 * gains[channel] ** 2
    return energy


# Masking transducer


def transducer(energy: float) -> float:
    """Eq. 4: T(A) = 2 A^(2.25/2) / (A^(2.05/2) + 1), A an energy, 1 at threshold; T(1) = 1."""
    above = TRANSDUCER_GAIN * energy**TRANSDUCER_NUMERATOR
    below = energy**TRANSDUCER_DENOMINATOR + 1
    return float(above / below)


def masking_transducer(energy: Array, effects: Effects) -> Array:
    """Eq. 4 on one level.

    Parameters
    ----------
    energy
        (3, C, h, w), 1 at threshold.
    effects
        Without ``masking`` the response is the magnitude of the weighted contrast, the root of
        the energy.

    Returns
    -------
    Array
        (3, C, h, w), 1 at threshold.
    """
    response = np.zeros(energy.shape)
    for at in np.ndindex(energy.shape):
        value = float(energy[at])
        response[at] = transducer(value) if effects.masking else math.sqrt(value)
    return response


# Spatial pooling


def spatial_pooling(response: Array, effects: Effects) -> Array:
    """3x3 box on every plane of one level (Fig. 6), its weights 1/9, its border replicated.

    Parameters
    ----------
    response
        (3, C, h, w).
    effects
        Without ``pooling`` the identity.

    Returns
    -------
    Array
        (3, C, h, w), the unit of ``response``.
    """
    if not effects.pooling:
        return response
    _, _, height, width = response.shape
    reach = POOLING_WIDTH // 2
    pooled = np.zeros(response.shape)
    for theta, channel, y, x in np.ndindex(response.shape):
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                near_y = min(max(y + dy, 0), height - 1)
                near_x = min(max(x + dx, 0), width - 1)
                pooled[theta, channel, y, x] += response[theta, channel, near_y, near_x]
    return pooled / POOLING_WIDTH**2


# Distance summation


def local_visual_difference(difference: Array, exponent: float = SUMMATION_EXPONENT) -> Array:
    """Eq. 5, with the absolute difference that it needs: the LVD of every node of one level.

    Parameters
    ----------
    difference
        P_1 - P_2, (3, C, h, w) over orientation and channel, 1 at threshold, of either sign.
    exponent
        No unit.

    Returns
    -------
    Array
        (h, w), JND to the power ``exponent``.
    """
    _, _, height, width = difference.shape
    lvd = np.zeros((height, width))
    for theta, channel, y, x in np.ndindex(difference.shape):
        lvd[y, x] += abs(difference[theta, channel, y, x]) ** exponent
    return lvd


def sum_down_paths(lvd: tuple[Array, ...], height: int, width: int) -> Array:
    """Sum of the LVD on the path from the root to every pixel (section 2, after Eq. 5).

    The parent of pixel (x, y) is node (x//2, y//2) of the finest level, and so on up to the root.

    Parameters
    ----------
    lvd
        One (h, w) a level, JND to the power of Eq. 5.
    height, width
        H and W of the image, pixels.

    Returns
    -------
    Array
        (H, W), JND to the power of Eq. 5; 0 without levels.
    """
    total = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            node_y, node_x = y, x
            for plane in reversed(lvd):
                node_y, node_x = node_y // 2, node_x // 2
                total[y, x] += plane[node_y, node_x]
    return total


# The whole, in the order of Fig. 2


def represent(xyz: Array, ppd: float, effects: Effects = ALL_ON) -> Pyramid:
    """Cone fundamentals to chromatic aberration (Fig. 2) of one image (3, H, W), XYZ in cd/m2."""
    return chromatic_aberration(cortex_filtering(cone_fundamentals(xyz)), ppd, effects)


def respond(pyramid: Pyramid, ppd: float, effects: Effects = ALL_ON) -> Responses:
    """Local contrast to spatial pooling (Fig. 2) of one image's representation."""
    levels = len(pyramid.details)
    contrast = tuple(local_contrast(pyramid, level) for level in range(levels))
    opponent = tuple(opponents(plane, effects) for plane in contrast)
    energy = tuple(
        csf_filtering(opponent[level], level_frequency(level, levels, ppd))
        for level in range(levels)
    )
    response = tuple(masking_transducer(plane, effects) for plane in energy)
    pooled = tuple(spatial_pooling(plane, effects) for plane in response)
    return Responses(contrast, opponent, energy, response, pooled)


def compare(test: Responses, reference: Responses) -> tuple[Array, ...]:
    """Eq. 5 on every level: the LVD of every node, one (h, w) a level, JND to the power 2.4."""
    return tuple(
        local_visual_difference(p1 - p2)
        for p1, p2 in zip(test.pooled, reference.pooled, strict=True)
    )


def jnd_map(test_xyz: Array, reference_xyz: Array, ppd: float, effects: Effects = ALL_ON) -> Array:
    """Visual difference map of the paper's observer (Fig. 2, Eq. 1 to 5).

    The coarsest lowpass is never compared, as in the paper: a uniform change of light scores 0.

    Parameters
    ----------
    test_xyz, reference_xyz
        CIE XYZ (3, H, W), cd/m2, of the same shape.
    ppd
        Pixels/degree.
    effects
        The stages that are on.

    Returns
    -------
    Array
        (H, W), JND.
    """
    test = respond(represent(test_xyz, ppd, effects), ppd, effects)
    reference = respond(represent(reference_xyz, ppd, effects), ppd, effects)
    _, height, width = test_xyz.shape
    total = sum_down_paths(compare(test, reference), height, width)
    return np.asarray(total ** (1 / SUMMATION_EXPONENT))
