"""A level's local visual difference and its gradient, as kernels of Triton.

They compute what `torch_vdm.model.level` does from channel weighting to distance summation, for the
signed observer with `Haar`, where the summation exponent is 6. `torch_vdm.run.kernels.level`
launches them; only it imports this, since Triton may not be installed.

A program has a block of nodes, or of parents, of one level of one item. What a node needs of its
neighbours is computed again for each node, so that nothing is written in between. All levels lie in
one column, as ``table`` says, see `triton_table`: details (B, 3, 3, ``nodes``), of cones and
orientations, and the parents of each level's nodes (B, 3, ``parents``), the lowpass that the eye is
adapted to. ``numbers`` is what `numbers_of` returns. Tuples of nine have three orientations for
each cone or channel.
"""

import math
from collections.abc import Iterable, Mapping

import torch
import triton
from torch import Tensor
from triton import language as tl

from torch_vdm.model import contrast, csf, distance, pooling
from torch_vdm.model.level import OF_LUMINANCE
from torch_vdm.run.kernels.triton_table import (
    FIRST,
    FIRST_OF_PARENTS,
    PARENTS_START,
    START,
    entry,
    level_of,
    sizes_of,
)

# Where each number begins in what `numbers_of` returns.
PASSED = tl.constexpr(0)
FREQUENCY = tl.constexpr(3)
GAIN = tl.constexpr(4)
BRIGHT = tl.constexpr(5)
DARK_CONES = tl.constexpr(7)
LUMINANCE_OF_CONES = tl.constexpr(10)
DARK_LIGHT = tl.constexpr(13)
DIM_LUMINANCE = tl.constexpr(14)
GLARE_LUMINANCE = tl.constexpr(15)
PEAK_LUMINANCE = tl.constexpr(16)
PEAK_FREQUENCY = tl.constexpr(17)
PEAK_EXPONENT = tl.constexpr(18)
ACHROMATIC_GAIN = tl.constexpr(19)
ACHROMATIC_DIMMING = tl.constexpr(20)
GLARE_EXPONENT = tl.constexpr(21)
CHROMATIC_DIMMING = tl.constexpr(22)
BAND_WIDTH = tl.constexpr(23)
BAND_FLOOR = tl.constexpr(24)
OPPONENTS = tl.constexpr(25)
TRANSDUCER_EXPONENT = tl.constexpr(34)

# The model's own limits.
LARGEST = tl.constexpr(contrast.LARGEST)
LARGEST_ENERGY = tl.constexpr(distance.LARGEST_DIFFERENCE**2)
SMALLEST_OFFSET = tl.constexpr(csf.SMALLEST_OFFSET)
POOLED = tl.constexpr(pooling.POOLED)
# One compiled form serves every size and every view.
SIZES = ("levels", "nodes", "parents")
PLANES = (
    *("details", "others", "parent", "other", "numbers", "local", "gradient", "slope", "found"),
    *("by_details", "by_others", "by_parent", "by_other"),
)
TABLES = ("table",)

LN2 = tl.constexpr(math.log(2.0))

# The constants from DARK_CONES on, those of `OF_LUMINANCE` in its order.
CONSTANTS = ("dark_cones", *OF_LUMINANCE, "opponents", "transducer_exponent")


def numbers_of(levels: Iterable[Tensor], constants: Mapping[str, Tensor]) -> Tensor:
    """Return all that levels depend on besides the images, (levels, 35).

    ``levels`` holds the parts of `Levels`, (levels, ...) each.
    """
    parts = [part.flatten(1) for part in levels]
    fixed = torch.cat([constants[name].flatten() for name in CONSTANTS])
    return torch.cat([*parts, fixed.expand(len(parts[0]), -1)], 1)


# One image.


@triton.jit
def _loaded(numbers, level):
    """Return the 35 numbers of a level as a tuple."""
    numbers += level * (TRANSDUCER_EXPONENT + 1)
    loaded = ()
    for number in tl.static_range(TRANSDUCER_EXPONENT + 1):
        loaded = loaded + (tl.load(numbers + number),)
    return loaded


@triton.jit
def _luminance(parent, plane, at, numbers):
    """Return the luminance at parents before it is clamped; as `adapted_luminance`."""
    mixed = tl.load(parent + at) * numbers[LUMINANCE_OF_CONES]
    for cone in tl.static_range(1, 3):
        mixed += tl.load(parent + cone * plane + at) * numbers[LUMINANCE_OF_CONES + cone]
    return mixed


@triton.jit
def _band(luminance, numbers):
    """Return how many octaves a level is above the peak of A, and the exponential's argument."""
    relative = tl.log2(numbers[FREQUENCY] / numbers[PEAK_FREQUENCY])
    faint = tl.log2(1.0 + numbers[PEAK_LUMINANCE] / luminance)
    octaves = relative + numbers[PEAK_EXPONENT] * faint
    offset = tl.maximum(tl.abs(octaves), SMALLEST_OFFSET) / numbers[BAND_WIDTH]
    return octaves, offset


@triton.jit
def _dimmed(luminance, numbers):
    """Return by how many octaves A, and C1 and C2, are dimmed."""
    dark = tl.log2(1.0 + numbers[DIM_LUMINANCE] / luminance)
    glare = tl.log2(1.0 + luminance / numbers[GLARE_LUMINANCE])
    achromatic = numbers[ACHROMATIC_DIMMING] * dark
    achromatic += numbers[GLARE_EXPONENT] * glare
    return achromatic, numbers[CHROMATIC_DIMMING] * dark


@triton.jit
def _sight(parent, plane, at, numbers):
    """Return the channel weighting at parents, as `sights_of`: 3 scales, 3 sensitivities."""
    luminance = tl.maximum(_luminance(parent, plane, at, numbers), 0.0)
    luminance += numbers[DARK_LIGHT]
    sight = ()
    for cone in tl.static_range(3):
        adapted = tl.maximum(tl.load(parent + cone * plane + at), 0.0)
        adapted += numbers[DARK_CONES + cone]
        sight = sight + (numbers[PASSED + cone] / adapted,)
    octaves, offset = _band(luminance, numbers)
    achromatic, chromatic = _dimmed(luminance, numbers)
    falling = tl.exp(-offset * tl.sqrt(offset))
    floor = numbers[BAND_FLOOR]
    shape = tl.where(octaves > 0.0, falling, floor + (1.0 - floor) * falling)
    gain = numbers[ACHROMATIC_GAIN] / numbers[GAIN]
    sight = sight + (gain * shape * tl.exp2(-achromatic),)
    dim = tl.exp2(-chromatic)
    for channel in tl.static_range(2):
        sight = sight + (numbers[BRIGHT + channel] * dim,)
    return sight


@triton.jit
def _contrasts(details, plane, at, sight):
    """Return the nine cone contrasts at nodes, as `local_contrast`."""
    contrasts = ()
    for number in tl.static_range(9):
        scaled = tl.load(details + number * plane + at) * sight[number // 3]
        contrasts = contrasts + (tl.minimum(tl.maximum(scaled, -LARGEST), LARGEST),)
    return contrasts


@triton.jit
def _opponents(contrasts, numbers):
    """Return the nine opponent contrasts of cone contrasts."""
    opponents = ()
    for number in tl.static_range(9):
        mixed = contrasts[number % 3] * numbers[OPPONENTS + 3 * (number // 3)]
        for cone in tl.static_range(1, 3):
            factor = numbers[OPPONENTS + 3 * (number // 3) + cone]
            mixed += contrasts[3 * cone + number % 3] * factor
        opponents = opponents + (mixed,)
    return opponents


@triton.jit
def _weighted(details, plane, at, sight, numbers):
    """Return the nine weighted contrasts at nodes."""
    opponents = _opponents(_contrasts(details, plane, at, sight), numbers)
    weighted = ()
    for number in tl.static_range(9):
        weighted = weighted + (opponents[number] * sight[3 + number // 3],)
    return weighted


# Two images.


@triton.jit
def _zeros(node, plane, count: tl.constexpr):
    """Return a tuple of so many blocks of zeros, of the type of a plane."""
    zeros = ()
    for _ in tl.static_range(count):
        zeros = zeros + (tl.full(node.shape, 0.0, plane.dtype.element_ty),)
    return zeros


@triton.jit
def _neighbour(number, y, x, height, width):
    """Return where one of the 3x3 neighbours is, the border repeated; also beyond the last node."""
    above = tl.minimum(tl.maximum(y + number // 3 - 1, 0), height - 1)
    before = tl.minimum(tl.maximum(x + number % 3 - 1, 0), width - 1)
    return above, before


@triton.jit
def _of_program(images, table, level, nodes, parents):
    """Return where the planes of a program's level and item begin."""
    item = tl.program_id(1).to(tl.int64)
    details, parent = 9 * item * nodes + entry(table, level, START), 3 * item * parents
    parent += entry(table, level, PARENTS_START)
    return images[0] + details, images[1] + details, images[2] + parent, images[3] + parent


@triton.jit
def _pooled(images, numbers, node, plane, parents, sizes):
    """Return the sums over the 3x3 neighbours: nine squared differences, three masking energies."""
    details, others, parent, other = images
    height, width, _, across, top, left = sizes
    y, x = node // width, node % width
    sums = _zeros(node, details, 12)
    for number in range(9):
        row, column = _neighbour(number, y, x, height, width)
        at, seen = row * width + column, (row + top) // 2 * across + (column + left) // 2
        one = _weighted(details, plane, at, _sight(parent, parents, seen, numbers), numbers)
        two = _weighted(others, plane, at, _sight(other, parents, seen, numbers), numbers)
        added = ()
        for each in tl.static_range(9):
            difference = one[each] - two[each]
            added = added + (sums[each] + difference * difference,)
        for channel in tl.static_range(3):
            mask = sums[9 + channel]
            for each in tl.static_range(3 * channel, 3 * channel + 3):
                mask += one[each] * one[each] + two[each] * two[each]
            added = added + (mask,)
        sums = added
    return sums


@triton.jit
def _unmasked(sums, channel: tl.constexpr, numbers):
    """Return the base that a channel's energies are divided by, and the factor of their ratio."""
    base = 1.0 + sums[9 + channel] / POOLED
    double = 2.0 * numbers[TRANSDUCER_EXPONENT]
    octaves = tl.log2(base)
    return base, tl.exp2(double * (1.0 - octaves) + octaves) / POOLED


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def local_difference(
    details,
    others,
    parent,
    other,
    numbers,
    table,
    local,
    levels,
    nodes,
    parents,
    block: tl.constexpr,
):
    """Write the local visual difference (B, 1, ``nodes``)."""
    level, node = level_of(table, levels, FIRST, block)
    nodes, parents = nodes.to(tl.int64), parents.to(tl.int64)
    numbers, sizes = _loaded(numbers, level), sizes_of(table, level)
    images = _of_program((details, others, parent, other), table, level, nodes, parents)
    sums = _pooled(images, numbers, node, nodes, parents, sizes)
    (total,) = _zeros(node, local, 1)
    for channel in tl.static_range(3):
        base, factor = _unmasked(sums, channel, numbers)
        for number in tl.static_range(3 * channel, 3 * channel + 3):
            energy = tl.minimum(sums[number] / base * factor, LARGEST_ENERGY)
            total += energy * energy * energy
    local += tl.program_id(1).to(tl.int64) * nodes + entry(table, level, START)
    tl.store(local + node, total, node < sizes[0] * sizes[1])


# The gradient: first what is to be pooled again; then, parent by parent, the gradients themselves.


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def slopes(
    gradient,
    details,
    others,
    parent,
    other,
    numbers,
    table,
    found,
    levels,
    nodes,
    parents,
    block: tl.constexpr,
):
    """Write the gradients by pooled energies, (B, 12, ``nodes``): nine of differences, three masks.

    ``gradient`` is that by the local visual difference, (B, 1, ``nodes``).
    """
    level, node = level_of(table, levels, FIRST, block)
    nodes, parents = nodes.to(tl.int64), parents.to(tl.int64)
    numbers, sizes = _loaded(numbers, level), sizes_of(table, level)
    images = _of_program((details, others, parent, other), table, level, nodes, parents)
    sums = _pooled(images, numbers, node, nodes, parents, sizes)
    inside, item = node < sizes[0] * sizes[1], tl.program_id(1).to(tl.int64)
    start = entry(table, level, START)
    found += 12 * item * nodes + start + node
    by_local = tl.load(gradient + item * nodes + start + node, inside, 0.0)
    double = 2.0 * numbers[TRANSDUCER_EXPONENT]
    for channel in tl.static_range(3):
        base, factor = _unmasked(sums, channel, numbers)
        gain = tl.exp2(double * (1.0 - tl.log2(base)))
        (hidden,) = _zeros(node, details, 1)
        for number in tl.static_range(3 * channel, 3 * channel + 3):
            energy = sums[number] / base * factor
            # Where the energy is clamped there is no slope.
            slope = tl.where(energy <= LARGEST_ENERGY, 3.0 * energy * energy, 0.0) * by_local
            hidden += slope * tl.minimum(energy, LARGEST_ENERGY)
            tl.store(found + number * nodes, slope * gain, inside)
        tl.store(found + (9 + channel) * nodes, -double * hidden / base, inside)


@triton.jit
def _by_details(details, plane, at, inside, sight, numbers, by_weighted, found, sums):
    """Write the gradient by details; return ``sums`` with that by the channel weighting added."""
    contrasts = _contrasts(details, plane, at, sight)
    opponents = _opponents(contrasts, numbers)
    by_sight = ()
    for cone in tl.static_range(3):
        by_scale = sums[cone]
        for orientation in tl.static_range(3):
            (by_contrast,) = _zeros(at, details, 1)
            for channel in tl.static_range(3):
                by_opponent = by_weighted[3 * channel + orientation] * sight[3 + channel]
                by_contrast += by_opponent * numbers[OPPONENTS + 3 * channel + cone]
            held = inside & (tl.abs(contrasts[3 * cone + orientation]) < LARGEST)
            by_contrast = tl.where(held, by_contrast, 0.0)
            offset = (3 * cone + orientation) * plane + at
            by_scale += by_contrast * tl.load(details + offset)
            tl.store(found + offset, by_contrast * sight[cone], inside)
        by_sight = by_sight + (by_scale,)
    for channel in tl.static_range(3):
        by_sensitivity = sums[3 + channel]
        for number in tl.static_range(3 * channel, 3 * channel + 3):
            by_sensitivity += tl.where(inside, by_weighted[number] * opponents[number], 0.0)
        by_sight = by_sight + (by_sensitivity,)
    return by_sight


@triton.jit
def _by_parent(parent, plane, at, inside, sight, numbers, by_sight, found):
    """Write the gradient by parents, from that by their channel weighting."""
    raw = _luminance(parent, plane, at, numbers)
    luminance = tl.maximum(raw, 0.0) + numbers[DARK_LIGHT]
    # The slopes of the logarithms in `_band` and `_dimmed`, times the natural logarithm of 2.
    dim, peak = numbers[DIM_LUMINANCE], numbers[PEAK_LUMINANCE]
    dark = -dim / (luminance * (luminance + dim))
    faint = -peak / (luminance * (luminance + peak))
    glare = 1.0 / (luminance + numbers[GLARE_LUMINANCE])
    achromatic, _ = _dimmed(luminance, numbers)
    octaves, offset = _band(luminance, numbers)
    # That of the band's shape, by octaves.
    width, floor = numbers[BAND_WIDTH], numbers[BAND_FLOOR]
    falling = 1.5 * tl.sqrt(offset) * tl.exp(-offset * tl.sqrt(offset)) / width
    shape = tl.where(octaves > 0.0, -falling, (1.0 - floor) * falling)
    shape = tl.where(tl.abs(octaves) < SMALLEST_OFFSET, 0.0, shape)
    gain = numbers[ACHROMATIC_GAIN] / numbers[GAIN] * tl.exp2(-achromatic)
    by_dimming = numbers[ACHROMATIC_DIMMING] * dark
    by_dimming += numbers[GLARE_EXPONENT] * glare
    by_luminance = gain * shape * numbers[PEAK_EXPONENT] * faint / LN2
    by_luminance = by_sight[3] * (by_luminance - sight[3] * by_dimming)
    chromatic = by_sight[4] * sight[4] + by_sight[5] * sight[5]
    by_luminance -= chromatic * numbers[CHROMATIC_DIMMING] * dark
    by_luminance = tl.where(raw >= 0.0, by_luminance, 0.0)
    for cone in tl.static_range(3):
        light = tl.load(parent + cone * plane + at)
        adapted = tl.maximum(light, 0.0) + numbers[DARK_CONES + cone]
        by_light = tl.where(light >= 0.0, by_sight[cone] * sight[cone] / adapted, 0.0)
        by_mean = by_luminance * numbers[LUMINANCE_OF_CONES + cone]
        tl.store(found + cone * plane + at, by_mean - by_light, inside)


@triton.jit(do_not_specialize=SIZES, do_not_specialize_on_alignment=PLANES)
def gradients(
    slope,
    details,
    others,
    parent,
    other,
    numbers,
    table,
    by_details,
    by_others,
    by_parent,
    by_other,
    levels,
    nodes,
    parents,
    first: tl.constexpr,
    second: tl.constexpr,
    block: tl.constexpr,
):
    """Write the gradients by details and parents, from what `slopes` writes.

    ``first``, ``second``: whether those of the first and of the second image are wanted.
    """
    level, node = level_of(table, levels, FIRST_OF_PARENTS, block)
    nodes, parents = nodes.to(tl.int64), parents.to(tl.int64)
    numbers, sizes = _loaded(numbers, level), sizes_of(table, level)
    height, width, above, across, top, left = sizes
    images = _of_program((details, others, parent, other), table, level, nodes, parents)
    details, others, parent, other = images
    found = (by_details, by_others, by_parent, by_other)
    by_details, by_others, by_parent, by_other = _of_program(found, table, level, nodes, parents)
    slope += 12 * tl.program_id(1).to(tl.int64) * nodes + entry(table, level, START)
    known = node < above * across
    seen = tl.minimum(node, above * across - 1)
    one, two = _sight(parent, parents, seen, numbers), _sight(other, parents, seen, numbers)
    by_one, by_two = _zeros(node, details, 6), _zeros(node, details, 6)
    for child in range(4):
        y, x = 2 * (node // across) - top + child // 2, 2 * (node % across) - left + child % 2
        inside = known & (y >= 0) & (y < height) & (x >= 0) & (x < width)
        # The box with a repeated border is its own transpose.
        pooled = _zeros(node, details, 12)
        for number in range(9):
            row, column = _neighbour(number, y, x, height, width)
            added = ()
            for each in tl.static_range(12):
                value = tl.load(slope + each * nodes + row * width + column)
                added = added + (pooled[each] + value,)
            pooled = added
        row, column = _neighbour(4, y, x, height, width)
        at = row * width + column
        weighted = _weighted(details, nodes, at, one, numbers)
        others_weighted = _weighted(others, nodes, at, two, numbers)
        by_weighted, by_others_weighted = (), ()
        for each in tl.static_range(9):
            by_difference = pooled[each] * (weighted[each] - others_weighted[each])
            by_mask = pooled[9 + each // 3]
            # The slope of a square is twice its root.
            slope_of_one = by_mask * weighted[each] + by_difference
            slope_of_two = by_mask * others_weighted[each] - by_difference
            by_weighted = by_weighted + (2.0 * slope_of_one / POOLED,)
            by_others_weighted = by_others_weighted + (2.0 * slope_of_two / POOLED,)
        if first:
            by_one = _by_details(
                details, nodes, at, inside, one, numbers, by_weighted, by_details, by_one
            )
        if second:
            by_two = _by_details(
                others, nodes, at, inside, two, numbers, by_others_weighted, by_others, by_two
            )
    if first:
        _by_parent(parent, parents, seen, known, one, numbers, by_one, by_parent)
    if second:
        _by_parent(other, parents, seen, known, two, numbers, by_two, by_other)


# Whether Triton's interpreter runs them, on a processor.
INTERPRETED = not isinstance(local_difference, triton.JITFunction)
