"""The calibrated observer: the pipeline of ``paper`` with other stages where data asked for them.

What is not here is the paper's own, imported: Eq. 1 to 3, the wavelet's frequencies, the shape of
the aberration, the Butterworth filter, the 3x3 box and Eq. 5. All numbers are arguments. Shapes,
orders and units as in ``paper``.
"""

import itertools
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
    level_frequency,
    local_visual_difference,
    opponents,
    spatial_pooling,
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
        q of masking; no unit.
    summation_exponent
        In the place of Eq. 5's 2.4; no unit.
    lowpass_gains
        Sensitivity of A, C1, C2 to the root lowpass, 1/contrast.
    charging
        Whether a difference counts for those pixels alone that made it.
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
    charging: bool


@dataclass(frozen=True)
class SignedResponses:
    """What each stage from local contrast to CSF filtering returns, one array a level.

    Pooling and masking follow, of two images, in `compare`.

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
    """

    contrast: tuple[Array, ...]
    opponent: tuple[Array, ...]
    luminance: tuple[Array, ...]
    weighted: tuple[Array, ...]


# The grid of nodes


@dataclass(frozen=True)
class Row:
    """Where the nodes of one level lie along one side of the image.

    Attributes
    ----------
    node
        Pixels of a whole node.
    begin
        The first node's first pixel, 0 or before the image, negative.
    side
        Pixels of the image.
    """

    node: int
    begin: int
    side: int

    def pixels(self, n: int) -> range:
        """Pixels of the image that node ``n`` has; none where it lies beyond a border."""
        start = self.begin + n * self.node
        return range(max(start, 0), min(start + self.node, self.side))

    def nodes(self) -> int:
        """Return how many nodes have pixels."""
        n = 0
        while self.pixels(n):
            n += 1
        return n

    def at(self, pixel: int) -> int:
        """Return the node that has a pixel."""
        n = 0
        while pixel not in self.pixels(n):
            n += 1
        return n


def rows_of(side: int) -> list[Row]:
    """Every level's nodes along a side, those of one pixel first, down to a single one.

    Nodes of 1, 2 and 4 pixels begin with the image. Of the next, those of 4^i pixels begin a third
    of one before it, those of 2 x 4^i pixels two thirds, both rounded down to nodes of 4 pixels.
    Where two are left the next level has both in one.
    """
    rows = [Row(1, 0, side)]
    while rows[-1].nodes() > 1:
        node = 2 * rows[-1].node
        # Of node = 4^i a third, of 2 x 4^i two: a third of the least power of 4 that is no smaller.
        power = 1
        while 4 * power < node:
            power *= 4
        begin = rows[-1].begin if rows[-1].nodes() == 2 else -4 * (power // 3)
        rows.append(Row(node, begin, side))
    return rows


def grid_of(height: int, width: int) -> list[tuple[Row, Row]]:
    """Every level's nodes along y and x, those of one pixel first, down to a single one."""
    down, across = rows_of(height), rows_of(width)
    levels = max(len(down), len(across))
    # A side that has a single node keeps it.
    return [
        (down[min(level, len(down) - 1)], across[min(level, len(across) - 1)])
        for level in range(levels)
    ]


# Cortex filtering


def window(plane: Array, row: Row, parent: Row) -> Array:
    """Give every parent two columns, and let a detail count real pixels, none for more than one.

    A column at the image's border has b of its a pixels. Those that it lacks are taken to be like
    N, the column beside it inside the image. Then

    - where its parent has both columns: nothing more;
    - where its parent has no other: N is that;
    - where both columns are all there are: they keep the mean of all their pixels, and their
      difference is that of as many pixels as the one with fewer has;
    - one column: repeated.

    Parameters
    ----------
    plane
        Lowpass (h, w) of one cone.
    row, parent
        Where its columns, and their parents, lie.
    """
    width = row.nodes()
    if width == 1:
        return np.concatenate((plane, plane), axis=1)
    a = row.node
    first, last = len(row.pixels(0)), len(row.pixels(width - 1))
    seen = {n: plane[:, n] for n in range(width)}
    if width == 2:
        mean = (first * plane[:, 0] + last * plane[:, 1]) / (first + last)
        half = min(first, last) / a * (plane[:, 0] - plane[:, 1]) / 2
        return np.stack((mean + half, mean - half), axis=1)
    seen[0] = ((a - first) * plane[:, 1] + first * plane[:, 0]) / a
    seen[width - 1] = ((a - last) * plane[:, width - 2] + last * plane[:, width - 1]) / a
    seen[-1], seen[width] = seen[1], seen[width - 2]
    columns = []
    for n in range(parent.nodes()):
        left = (parent.begin + n * parent.node - row.begin) // a
        columns += [seen[left], seen[left + 1]]
    return np.stack(columns, axis=1)


@dataclass(frozen=True)
class WindowedPyramid(Pyramid):
    """A pyramid, and for each of its nodes the mean of what its details see.

    Attributes
    ----------
    windows
        The mean of the four columns and rows of every detail, each (3, h, w), cd/m2.
    """

    windows: tuple[Array, ...]


def cortex_filtering(sml: Array) -> WindowedPyramid:
    """Eq. 2 from the pixels to the root, where every pixel has the same weight.

    The lowpass of a node is the mean of the pixels that it has; that of its window is Eq. 2's.

    Parameters
    ----------
    sml
        S, M, L (3, H, W), cd/m2.
    """
    grid = grid_of(*sml.shape[1:])
    lowpass = [sml]
    details: list[Array] = []
    windows: list[Array] = []
    for (y_child, x_child), (y_row, x_row) in itertools.pairwise(grid):
        seen = [window(window(plane.T, y_child, y_row).T, x_child, x_row) for plane in lowpass[0]]
        step = [haar_step(plane) for plane in seen]
        windows.insert(0, np.stack([mean for mean, _ in step]))
        details.insert(0, np.stack([detail for _, detail in step], axis=1))
        means = np.zeros((3, y_row.nodes(), x_row.nodes()))
        for cone, y, x in np.ndindex(means.shape):
            rows, columns = y_row.pixels(y), x_row.pixels(x)
            means[cone, y, x] = sml[
                cone, rows.start : rows.stop, columns.start : columns.stop
            ].mean()
        lowpass.insert(0, means)
    return WindowedPyramid(tuple(lowpass), tuple(details), tuple(windows))


# Local contrast


def parent_lowpass(pyramid: WindowedPyramid, level: int) -> Array:
    """Lowpass "one level up in the quad-tree" of every node of a level, (3, h, w), cd/m2.

    Of the parent's window. The parent of a node has its pixels; the root, which has none, uses its
    own.
    """
    own = pyramid.windows[level]
    if level == 0:
        return own
    grid = grid_of(*pyramid.lowpass[-1].shape[1:])[::-1]
    (y_row, x_row), (y_up, x_up) = grid[level], grid[level - 1]
    parent = np.zeros(own.shape)
    for y in range(own.shape[1]):
        for x in range(own.shape[2]):
            above = y_up.at(y_row.pixels(y)[0]), x_up.at(x_row.pixels(x)[0])
            parent[:, y, x] = pyramid.windows[level - 1][:, above[0], above[1]]
    return parent


def local_contrast(pyramid: WindowedPyramid, level: int, dark_light: float) -> Array:
    """Cone contrasts dS/S, dM/M, dL/L of one level (3, 3, h, w) over orientation and cone.

    Parameters
    ----------
    pyramid
        The representation after chromatic aberration, cd/m2.
    level
        0 for the root.
    dark_light
        cd/m2.
    """
    light = np.maximum(parent_lowpass(pyramid, level), 0.0)
    return np.asarray(pyramid.details[level] / (light + cone_dark_light(dark_light)[:, None, None]))


# CSF filtering


def local_luminance(pyramid: WindowedPyramid, level: int, dark_light: float) -> Array:
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


def transducer(energy: float, masks: float, exponent: float) -> float:
    """Signed, for Eq. 4: D (2 / (1 + E))^(2q) of the squared difference D, q = ``exponent``.

    1 where a contrast of 1 differs from none: D and E are 1.
    """
    return float(energy * (2 / (1 + masks)) ** (2 * exponent))


def masked_differences(
    test: Array, reference: Array, effects: Effects, parameters: CalibratedParameters
) -> Array:
    """Spatial pooling and masking transducer of one level: squared differences, 1 at threshold.

    (v_1 - v_2)^2 is pooled, because signed contrasts of neighbours alternate and would cancel. What
    masks it is the sum of v_1^2 + v_2^2 over all orientations of its channel, pooled alike.

    Parameters
    ----------
    test, reference
        v, (orientations, C, h, w), signed; 1 at threshold.
    effects
        Without ``masking`` nothing masks.
    parameters
        The observer's numbers.
    """
    energy = spatial_pooling((test - reference) ** 2, effects)
    if not effects.masking:
        return energy
    squares = (test**2 + reference**2).sum(axis=0, keepdims=True)
    masks = spatial_pooling(squares, effects)
    left = np.zeros(energy.shape)
    for theta, channel, y, x in np.ndindex(energy.shape):
        left[theta, channel, y, x] = transducer(
            float(energy[theta, channel, y, x]),
            float(masks[0, channel, y, x]),
            parameters.transducer_exponent,
        )
    return left


# Charging


def nearest(plane: Array, y: int, x: int) -> float:
    """Return the value of a node; beyond the border that of the nearest."""
    height, width = plane.shape
    return float(plane[min(max(y, 0), height - 1), min(max(x, 0), width - 1)])


def mean_around(plane: Array, y: int, x: int, reach: int) -> float:
    """Return the mean over a node and ``reach`` of them to each side, the border repeated."""
    steps = range(-reach, reach + 1)
    return float(np.mean([nearest(plane, y + i, x + j) for i in steps for j in steps]))


def squared_change(test: Array, reference: Array) -> Array:
    """Return c of every node (h, w): the sum over S, M, L (3, h, w) of the squared difference."""
    return np.asarray(((test - reference) ** 2).sum(0))


def change_ratios(change: Array, width: int = 1) -> Array:
    """Return r of every node: c near by over c around it, 0 where neither differs.

    Parameters
    ----------
    change
        c, (h, w).
    width
        How many nodes lie in the width of one: 1, or 2 where they overlap.
    """
    ratios = np.zeros(change.shape)
    for y, x in np.ndindex(change.shape):
        around = mean_around(change, y, x, 5 * width)
        if around > 0.0:
            ratios[y, x] = mean_around(change, y, x, width) / around
    return ratios


def inherited_share(ratio: float) -> float:
    """q: the share of its parent's sum that a node of a ratio r is charged."""
    return min(1.0, 1.005 * ratio / (ratio + 0.005)) ** 4


def own_share(ratio: float) -> float:
    """Return the share of its own difference that a node is charged behind a filter."""
    return min(1.0, ratio / 0.1) ** 4


def changes_of_nodes(test: Array, reference: Array) -> list[Array]:
    """Return c of the nodes of every level, from the root to those of 2 pixels.

    Parameters
    ----------
    test, reference
        Cone images (3, H, W), cd/m2.
    """
    grid = grid_of(*test.shape[1:])[:0:-1]
    changes = []
    for y_row, x_row in grid:
        means = [np.zeros((3, y_row.nodes(), x_row.nodes())) for _ in range(2)]
        for n, m in np.ndindex(means[0].shape[1:]):
            rows, columns = y_row.pixels(n), x_row.pixels(m)
            part = slice(None), slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
            for mean, image in zip(means, (test, reference), strict=True):
                mean[:, n, m] = image[part].mean((1, 2))
        changes.append(squared_change(*means))
    return changes


# Distance summation


def sum_down_paths(
    lvd: tuple[Array, ...],
    root: float,
    height: int,
    width: int,
    ratios: list[Array] | None = None,
    filtered: bool = False,
) -> Array:
    """T (H, W) of the finest node of every pixel.

    From the root down T(n) = D(n) + q(n) T(parent of n); the parent of a node has its pixels.

    Parameters
    ----------
    lvd
        D, one (h, w) a level, that of the root first.
    root
        T of the root's parent: the lowpass term.
    height, width
        Of the image, pixels.
    ratios
        r, one (h, w) a level; None: nothing is charged, q is 1.
    filtered
        Whether D is charged too.
    """
    total = np.full((height, width), root)
    grid = grid_of(height, width)[:0:-1]
    for level, ((y_row, x_row), plane) in enumerate(zip(grid, lvd, strict=True)):
        for n, m in np.ndindex(plane.shape):
            own, inherited = 1.0, 1.0
            if ratios is not None:
                inherited = inherited_share(float(ratios[level][n, m]))
                own = own_share(float(ratios[level][n, m])) if filtered else 1.0
            for y in y_row.pixels(n):
                for x in x_row.pixels(m):
                    total[y, x] = own * plane[n, m] + inherited * total[y, x]
    return total


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


# A difference between means counts for no more, JND: values below 0 may make it any.
LARGEST_DIFFERENCE = 1e5


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
        seen = min(abs(parameters.lowpass_gains[channel] * value), LARGEST_DIFFERENCE)
        term += seen**parameters.summation_exponent
    return float(term)


# The whole, in the order of Fig. 2


def represent(
    xyz: Array, ppd: float, parameters: CalibratedParameters, effects: Effects = ALL_ON
) -> WindowedPyramid:
    """Cone fundamentals to chromatic aberration (Fig. 2) of one image (3, H, W), XYZ in cd/m2."""
    return chromatic_aberration(
        cortex_filtering(cone_fundamentals(xyz)),
        ppd,
        effects,
        parameters.aberration_cutoff,
        parameters.aberration_exponent,
    )


def respond(
    pyramid: WindowedPyramid,
    ppd: float,
    parameters: CalibratedParameters,
    effects: Effects = ALL_ON,
) -> SignedResponses:
    """Local contrast to CSF filtering (Fig. 2) of one image's representation."""
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
    return SignedResponses(contrast, opponent, luminance, tuple(weighted))


def compare(
    test: SignedResponses,
    reference: SignedResponses,
    parameters: CalibratedParameters,
    effects: Effects = ALL_ON,
) -> tuple[Array, ...]:
    """`masked_differences`, then Eq. 5 of their root: D of every node.

    One (h, w) a level, that of the root first.

    Returns
    -------
    tuple of Array
        JND to the power ``summation_exponent``.
    """
    return tuple(
        local_visual_difference(
            np.sqrt(masked_differences(v1, v2, effects, parameters)), parameters.summation_exponent
        )
        for v1, v2 in zip(test.weighted, reference.weighted, strict=True)
    )


def jnd_map(
    test_xyz: Array,
    reference_xyz: Array,
    ppd: float,
    parameters: CalibratedParameters,
    effects: Effects = ALL_ON,
) -> Array:
    """Visual difference map of the calibrated observer, ``Haar``.

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
    ratios = None
    if parameters.charging:
        cones = cone_fundamentals(test_xyz), cone_fundamentals(reference_xyz)
        ratios = [change_ratios(change) for change in changes_of_nodes(*cones)]
    root = lowpass_term(test, reference, effects, parameters)
    total = sum_down_paths(lvd, root, height, width, ratios)
    return np.asarray(total ** (1 / parameters.summation_exponent))
