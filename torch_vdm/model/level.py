"""One level of two images, from details to their local visual difference: Fig. 2 from box 3 on.

Chromatic aberration and adaptation, local contrast, opponents contrast space and contrast
sensitivity are of one image; masking and spatial pooling of two, in the order of the observer:

- the paper's takes the difference of two transducers' outputs, and pools it;
- the calibrated one pools the squared difference of weighted contrasts, which keep their sign, and
  what masks it, and masks what is pooled.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.cones import of_grey
from torch_vdm.model.contrast import adapted, local_contrast, opponents
from torch_vdm.model.csf import bandpass
from torch_vdm.model.distance import (
    cubes,
    local_visual_difference,
    local_visual_difference_of_energy,
)
from torch_vdm.model.grid import NONE, Before
from torch_vdm.model.masking import energy_transducer, masking_energy, unmasked
from torch_vdm.model.matrix import mix
from torch_vdm.model.pooling import (
    POOLED,
    covering,
    phase_energy,
    pool,
    pool_halves,
    pool_sums,
    surround,
    surround_halves,
    within,
)
from torch_vdm.model.quadtree import push
from torch_vdm.model.steps import PLAIN, Steps

# The constants that the sensitivity in the local luminance depends on.
OF_LUMINANCE = (
    "luminance_of_cones",
    "dark_light",
    "dim_luminance",
    "glare_luminance",
    "peak_luminance",
    "peak_frequency",
    "peak_exponent",
    "achromatic_gain",
    "achromatic_dimming",
    "glare_exponent",
    "chromatic_dimming",
    "band_width",
    "band_floor",
)


class Level(NamedTuple):
    """What a level of the transform responds to, as far as it does not depend on the image.

    For planes (h, w) of one level the last two sides are 1 and 1; for the nodes of several levels
    in a row, they are 1 and as many. Where there are as many as orientations, one stands for all
    where all have the same.
    """

    passed: Tensor
    """(3, 1, 1): the share of each cone's details that chromatic aberration leaves."""
    frequency: Tensor
    """(as many, 1, 1), in cycles/degree: the frequency of the best response."""
    gain: Tensor
    """(as many, 1, 1): what contrast is divided by."""
    sensitivity: Tensor
    """(channels, as many, 1, 1): the contrast sensitivity, over the gain. Where the luminance is
    local, that of C1 and C2 in bright light."""


class Levels(NamedTuple):
    """The same of all levels of an image, level 0 first, without the last two sides."""

    passed: Tensor
    """(levels, 3)."""
    frequency: Tensor
    """(levels, as many)."""
    gain: Tensor
    """(levels, as many)."""
    sensitivity: Tensor
    """(levels, channels, as many)."""

    def only(self, number: int) -> Level:
        """Return one level."""
        # Copies, for compiled code is specialised on views and their offsets.
        return Level(*(part[number, ..., None, None].clone() for part in self))

    def in_a_row(self, nodes: Sequence[int]) -> Level:
        """Return the coarsest levels as one, whose plane is the ``nodes`` of each in a row."""
        # For each node its level; the size is given so that nothing is read back from the device.
        counts = torch.tensor(nodes, device=self.passed.device)
        which = torch.repeat_interleave(counts, output_size=sum(nodes))
        # Of planes of two dimensions a selection is much faster than of those of three. Copies, as
        # in `only`.
        return Level(
            *(
                part.flatten(1)
                .mT.contiguous()
                .index_select(1, which)
                .unflatten(0, part.shape[1:])
                .unsqueeze(-2)
                .clone()
                for part in self
            )
        )


class Sight(NamedTuple):
    """What turns the details of an image at a level into contrasts and weights them."""

    scale: Tensor | None
    """(B, 3, h, w): for each cone the share that chromatic aberration leaves, over what the
    parent is adapted to. None where the details are weighted contrast already, or those of one
    plane, whose contrast in each channel the sensitivity has."""
    sensitivity: Tensor
    """(B, channels, orientations, h, w): the contrast sensitivity of each channel, or one
    orientation or node of it where all have the same."""

    def pushed(self, size: tuple[int, int], items: int = 1, before: Before = NONE) -> "Sight":
        """Return what is given at the parents at their children, as `push` takes them."""
        shared = self.sensitivity.shape[-2:] == (1, 1)
        children = size, items, before
        sensitivity = self.sensitivity if shared else push(self.sensitivity, *children)
        return Sight(None if self.scale is None else push(self.scale, *children), sensitivity)

    def of(self, orientations: slice) -> "Sight":
        """Return the sight of some orientations."""
        if self.sensitivity.shape[2] == 1:
            return self
        return Sight(self.scale, self.sensitivity[:, :, orientations])


class Options(NamedTuple):
    """What the boxes of a level depend on beside details and sights."""

    signed: bool
    """As `Observer.signed`."""
    masking: bool
    """As `Effects.masking`."""
    phases: int
    """As `Transform.phases`."""
    overlapping: bool
    """Whether nodes overlap, `Transform.shifts` of them in the width of one."""
    pooled: int
    """How many nodes in a row are pooled: 3, or 1."""
    cubes: bool
    """Whether the exponent of the summation is 6, and so that of energies 3."""
    matrix: Tensor
    """(channels, 3), of Eq. 3."""
    transducer_exponent: Tensor
    summation_exponent: Tensor

    @property
    def energies(self) -> bool:
        """Whether squares are pooled.

        Neighbours with signs would cancel; and of overlapping nodes and of quadrature pairs the
        energy hardly depends on the phase of a grating.
        """
        return self.signed or self.overlapping


def local_difference(
    details: Tensor,
    others: Tensor,
    sight: Sight,
    other_sight: Sight,
    options: Options,
    steps: Steps = PLAIN,
    items: int = 1,
) -> Tensor:
    """Return the local visual difference (B, 1, h, w) of a level of two images.

    ``details`` and ``others`` are (B, 3, orientations, h, w); sights at the nodes themselves.
    """
    difference = steps(response_difference, details, others, sight, other_sight, options)
    return gathered(difference, options, steps, items)


def gathered(difference: Tensor, options: Options, steps: Steps = PLAIN, items: int = 1) -> Tensor:
    """Return the local visual difference (B, 1, h, w) of `difference_of` two images."""
    around = surrounded(difference, options, steps, items)
    return within(steps(pooled_difference, around, options), difference.shape[-2], items)


def surrounded(
    difference: Tensor, options: Options, steps: Steps = PLAIN, items: int = 1
) -> Tensor:
    """Return `difference_of` two images with the neighbours that `pooled_difference` takes."""
    if options.overlapping:
        rows: Tensor = steps(
            pool_halves, surround_halves(difference, options.pooled), options.pooled, -1
        )
        return rows
    return surround(difference, items) if options.pooled > 1 else difference


def pooled_difference(around: Tensor, options: Options) -> Tensor:
    """Return the local visual difference of what `surrounded` gives.

    Printed responses are pooled as a difference, for pooling is linear; others come as squares.
    """
    if not options.energies:
        pooled = pool(around) if options.pooled > 1 else around
        return local_visual_difference(pooled, options.summation_exponent)
    # Sums, which are divided where it costs least.
    if options.overlapping:
        pooled, count = pool_halves(around, options.pooled, -2), covering(options.pooled)
    elif options.pooled > 1:
        pooled, count = pool_sums(around), POOLED
    else:
        pooled, count = around, 1.0
    masked = options.signed and options.masking
    pooled, masks = (pooled[:, :, :-1], pooled[:, :, -1:] / count) if masked else (pooled, None)
    if options.cubes:
        if masks is None:
            return cubes(pooled, 1.0 / count)
        # What masks is no less than half of what differs: no slope of their ratio overflows, nor of
        # what is left, where values below 0 make differences that light has not.
        base = masks + 1.0
        octaves = unmasked(masks, options.transducer_exponent) + torch.log2(base)
        return cubes(pooled / base, torch.exp2(octaves - math.log2(count)))
    left: Tensor | float = -math.log2(count)
    if masks is not None:
        left = unmasked(masks, options.transducer_exponent) + left
    return local_visual_difference_of_energy(pooled, options.summation_exponent, left)


def response(details: Tensor, sight: Sight, options: Options) -> Tensor:
    """Return the responses of one level of one image: local contrast to the transducer.

    Signed ones are weighted contrast: what masks their difference is of both images.
    """
    contrast = details
    if sight.scale is not None:
        contrast = opponents(local_contrast(details, sight.scale), options.matrix)
    weighted = contrast * sight.sensitivity
    if options.signed:
        return weighted
    return energy_transducer(weighted * weighted) if options.masking else weighted.abs()


def difference_of(one: Tensor, other: Tensor, options: Options) -> Tensor:
    """Return what is pooled of two images' responses at a level, (B, channels, n, h, w).

    Their differences, or the energy of these, one for all phases of an orientation. Where signed
    ones are masked, what masks them is the last of the n.
    """
    difference = one - other
    if not options.energies:
        return difference
    energy = phase_energy(difference, options.phases)
    if not (options.signed and options.masking):
        return energy
    return torch.cat((energy, masking_energy(one, other)), 2)


def response_difference(
    details: Tensor, other_details: Tensor, sight: Sight, other_sight: Sight, options: Options
) -> Tensor:
    """Return `difference_of` two images' responses at a level.

    Each image by itself: equal images then take equal paths through the vectorised loops, and
    their difference is exactly 0.
    """
    one, other = response(details, sight, options), response(other_details, other_sight, options)
    return difference_of(one, other, options)


def response_difference_at(
    details: Tensor, other_details: Tensor, around: tuple[Any, ...], options: Options
) -> Tensor:
    """Return `response_difference` where the parents are given for every node.

    ``around`` is what `sights_of` takes.
    """
    first, second = sights_of(*around)
    return response_difference(details, other_details, first, second, options)


def sights_of(
    parents: Sequence[Tensor],
    level: Level,
    constants: Mapping[str, Tensor],
    local: bool,
    chromatic: bool,
    grey: Tensor | None,
) -> list[Sight]:
    """Return the sight of a level at the parents of each image, fewer than its nodes.

    ``parents`` are the lowpass of each, (B, 3, h, w); ``local``: in the local luminance. ``grey``,
    (3,): the parents are one plane, and the cones' are so many times it.
    """
    sights = []
    for plane in parents:
        parent = of_grey(plane, grey)
        scale = level.passed / adapted(parent, constants["dark_cones"])
        sensitivity = level.sensitivity.unsqueeze(0)
        if local:
            sensitivity = sensitivity_at(parent, level, constants, chromatic)
        if grey is not None:
            # Of one detail the three cones' contrasts, mixed, times the sensitivity.
            mixed = mix(constants["opponents"], of_grey(scale, grey)).unsqueeze(2)
            sights.append(Sight(None, mixed * sensitivity))
            continue
        sights.append(Sight(scale, sensitivity))
    return sights


def adapted_luminance(lowpass: Tensor, constants: Mapping[str, Tensor]) -> Tensor:
    """Return the luminance (B, 1, h, w) that the eye is adapted to, cd/m2, its own light in it."""
    seen = mix(constants["luminance_of_cones"], lowpass).clamp_min(0.0)
    return seen + constants["dark_light"]


def sensitivity_at(
    parent: Tensor, level: Level, constants: Mapping[str, Tensor], chromatic: bool
) -> Tensor:
    """Return the contrast sensitivity in the local luminance, at the parents."""
    luminance = adapted_luminance(parent, constants).unsqueeze(2)
    dark = torch.log2(1.0 + constants["dim_luminance"] / luminance)
    glare = torch.log2(1.0 + luminance / constants["glare_luminance"])
    faint = torch.log2(1.0 + constants["peak_luminance"] / luminance)
    relative = torch.log2(level.frequency / constants["peak_frequency"])
    octaves = relative + constants["peak_exponent"] * faint
    dimmed = constants["achromatic_dimming"] * dark + constants["glare_exponent"] * glare
    shape = bandpass(octaves, constants["band_width"], constants["band_floor"])
    gain = constants["achromatic_gain"] / level.gain
    achromatic = gain * shape * torch.exp2(-dimmed)
    if not chromatic:
        return achromatic
    dim = torch.exp2(-constants["chromatic_dimming"] * dark)
    # Flat, for of planes with one channel compiled code would make a plane of channels.
    channels = achromatic.flatten(2), (level.sensitivity * dim).flatten(2)
    sensitivity: Tensor = torch.cat(channels, 1).unflatten(2, achromatic.shape[2:])
    return sensitivity
