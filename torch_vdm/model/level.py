"""One level of two images, from details to their local visual difference: Fig. 2 from box 3 on.

Chromatic aberration and adaptation, local contrast, opponents contrast space and contrast
sensitivity act on one image; masking and spatial pooling act on two, in the observer's order:

- the paper's takes the difference of the two transducer outputs, and pools it;
- the calibrated one pools the squared difference of weighted contrasts, which keep their sign, and
  pools the energy that masks it, then masks the pooled difference.
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
)
from torch_vdm.model.quadtree import push, surround
from torch_vdm.model.steps import PLAIN, Steps

# The constants that the sensitivity at the local luminance depends on;
# `torch_vdm.run.kernels.triton_level` finds each by its place here.
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

    For planes (h, w) of one level the last two dimensions are 1 and 1; for the nodes of several
    levels in a column they are the number of nodes and 1. The dimension of the orientations is 1
    where all of them have the same value.
    """

    passed: Tensor
    """(1, 3, 1, 1): the fraction of each cone's details that chromatic aberration passes."""
    frequency: Tensor
    """(1, orientations, 1, 1), in cycles/degree: the frequency of the best response."""
    gain: Tensor
    """(1, orientations, 1, 1): what contrast is divided by."""
    sensitivity: Tensor
    """(1, channels, orientations, 1, 1): the contrast sensitivity, divided by the gain. Where the
    luminance is local, that of C1 and C2 in bright light."""


class Levels(NamedTuple):
    """The same for all levels of an image, level 0 first, without the last two dimensions."""

    passed: Tensor
    """(levels, 3)."""
    frequency: Tensor
    """(levels, orientations)."""
    gain: Tensor
    """(levels, orientations)."""
    sensitivity: Tensor
    """(levels, channels, orientations)."""

    def only(self, number: int) -> Level:
        """Return one level."""
        # Copies: compiled code is specialised on views and their offsets.
        return Level(*(part[None, number, ..., None, None].clone() for part in self))

    def in_a_column(self, which: Tensor) -> Level:
        """Return the levels as one, whose plane is a column of nodes.

        ``which``: (N,), the level of each node. Every number is then given for each.
        """
        # All at once, and from two dimensions, which is much faster than from three.
        flat = [part.flatten(1) for part in self]
        found = torch.cat(flat, 1).mT.contiguous().index_select(1, which)
        parts = found.split([part.shape[1] for part in flat])
        # Copies, as in `only`.
        return Level(
            *(
                part.unflatten(0, (1, *of.shape[1:])).unsqueeze(-1).clone()
                for part, of in zip(parts, self, strict=True)
            )
        )


class Sight(NamedTuple):
    """The channel weighting: it turns an image's details at a level into weighted contrasts."""

    scale: Tensor | None
    """(B, 3, h, w): for each cone, the fraction that chromatic aberration passes, divided by what
    the parent is adapted to. None where the details are weighted contrast already, or those of one
    plane, for which the sensitivity includes the contrast of each channel."""
    sensitivity: Tensor
    """(B, channels, orientations, h, w): the contrast sensitivity of each channel; a single
    orientation or node where all have the same."""

    def pushed(self, size: tuple[int, int], before: Before = NONE) -> "Sight":
        """Return the weighting given at the parents for their children; arguments as in `push`."""

        def at_children(parents: Tensor) -> Tensor:
            return push(parents, size, before).contiguous()

        shared = self.sensitivity.shape[-2:] == (1, 1)
        sensitivity = self.sensitivity if shared else at_children(self.sensitivity)
        return Sight(None if self.scale is None else at_children(self.scale), sensitivity)

    def of(self, orientations: slice) -> "Sight":
        """Return the channel weighting of some orientations."""
        if self.sensitivity.shape[2] == 1:
            return self
        return Sight(self.scale, self.sensitivity[:, :, orientations])


def pushed(sights: Sequence[Sight], size: tuple[int, int], before: Before = NONE) -> list[Sight]:
    """Return two images' channel weightings `Sight.pushed`; one that both share only once."""
    one, other = sights
    first = one.pushed(size, before)
    return [first, first if other is one else other.pushed(size, before)]


class Options(NamedTuple):
    """What the boxes of a level depend on besides details and channel weightings."""

    signed: bool
    """As `Observer.signed`."""
    masking: bool
    """As `Effects.masking`."""
    phases: int
    """As `Transform.phases`."""
    overlapping: bool
    """Whether nodes overlap, `Transform.shifts` of them per node width."""
    pooled: int
    """How many nodes in a row are pooled: 3, or 1."""
    cubes: bool
    """Whether the summation exponent is 6, which makes that of energies 3."""
    matrix: Tensor
    """(channels, 3), of Eq. 3."""
    transducer_exponent: Tensor
    summation_exponent: Tensor

    @property
    def energies(self) -> bool:
        """Whether squares are pooled.

        Signed neighbours would cancel; and the energy of overlapping nodes and of quadrature
        pairs hardly depends on the phase of a grating.
        """
        return self.signed or self.overlapping

    @property
    def ring(self) -> tuple[int, int]:
        """How many nodes before and after each, in y and in x, are pooled with it."""
        if self.overlapping:
            return self.pooled, self.pooled - 1
        return self.pooled // 2, self.pooled // 2


def local_difference(
    details: Tensor,
    others: Tensor,
    sight: Sight,
    other_sight: Sight,
    options: Options,
    steps: Steps = PLAIN,
) -> Tensor:
    """Return the local visual difference (B, 1, h, w) of two images at a level.

    ``details`` and ``others`` are (B, 3, orientations, h, w); the channel weightings are those at
    the nodes themselves.
    """
    difference = steps(response_difference, details, others, sight, other_sight, options)
    return gathered(difference, options, steps)


def gathered(difference: Tensor, options: Options, steps: Steps = PLAIN) -> Tensor:
    """Return the local visual difference (B, 1, h, w) from the `difference_of` two images."""
    around = summed_across(surround(difference, *options.ring), options, steps)
    local: Tensor = steps.valid(pooled_difference, around, options)
    return local


def summed_across(around: Tensor, options: Options, steps: Steps = PLAIN) -> Tensor:
    """Return what `pooled_difference` takes of the `difference_of` two images with its ring."""
    if not options.overlapping:
        return around
    summed: Tensor = steps(pool_halves, around, options.pooled, -1)
    return summed


def pooled_difference(around: Tensor, options: Options) -> Tensor:
    """Return the local visual difference from what `summed_across` gives.

    The paper's responses are pooled as a difference, because pooling is linear; others as squares.
    """
    if not options.energies:
        pooled = pool(around) if options.pooled > 1 else around
        return local_visual_difference(pooled, options.summation_exponent)
    # Sums; they are divided where that costs least.
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
        # The masking energy is at least half of the energy that differs: no slope of their ratio or
        # of the remaining factor overflows, even where values below 0 give differences that light
        # never has.
        base = masks + 1.0
        octaves = unmasked(masks, options.transducer_exponent) + torch.log2(base)
        return cubes(pooled / base, torch.exp2(octaves - math.log2(count)))
    left: Tensor | float = -math.log2(count)
    if masks is not None:
        left = unmasked(masks, options.transducer_exponent) + left
    return local_visual_difference_of_energy(pooled, options.summation_exponent, left)


def response(details: Tensor, sight: Sight, options: Options) -> Tensor:
    """Return the responses of one image at a level, from local contrast to the transducer.

    Signed responses are weighted contrast: the masking of their difference involves both images.
    """
    contrast = details
    if sight.scale is not None:
        contrast = opponents(local_contrast(details, sight.scale), options.matrix)
    weighted = contrast * sight.sensitivity
    if options.signed:
        return weighted
    return energy_transducer(weighted * weighted) if options.masking else weighted.abs()


def difference_of(one: Tensor, other: Tensor, options: Options) -> Tensor:
    """Return what is pooled from two images' responses at a level, (B, channels, n, h, w).

    These are their differences, or the energy of the differences, one for all phases of an
    orientation. Where signed responses are masked, the masking energy is the last of the n.
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
    """Return the `difference_of` two images' responses at a level.

    Each image is computed separately: equal images then take equal paths through the vectorised
    loops, and their difference is exactly 0.
    """
    one, other = response(details, sight, options), response(other_details, other_sight, options)
    return difference_of(one, other, options)


def response_difference_at(
    details: Tensor, other_details: Tensor, around: tuple[Any, ...], options: Options
) -> Tensor:
    """Return `response_difference` where the parents are given for every node.

    ``around`` is what `sights_of` takes; both images share the parents of one.
    """
    sights = sights_of(*around)
    return response_difference(details, other_details, sights[0], sights[-1], options)


def sights_of(
    parents: Sequence[Tensor],
    level: Level,
    constants: Mapping[str, Tensor],
    local: bool,
    chromatic: bool,
    grey: Tensor | None,
) -> list[Sight]:
    """Return each image's channel weighting of a level, at the parents, which are fewer than nodes.

    ``parents`` are the lowpass planes (B, 3, h, w) of the images; ``local``: whether sensitivity
    follows the local luminance. With ``grey`` (3,) the parents are one plane each, and the cone
    planes are ``grey`` times it.
    """
    sights = []
    # How far the frequency is from the peak in bright light, in octaves.
    relative = torch.log2(level.frequency / constants["peak_frequency"]) if local else None
    for plane in parents:
        parent = of_grey(plane, grey)
        scale = level.passed / adapted(parent, constants["dark_cones"])
        sensitivity = level.sensitivity
        if relative is not None:
            sensitivity = sensitivity_at(parent, level, relative, constants, chromatic)
        if grey is not None:
            # Per unit of detail: the contrasts of the three cones, mixed, times the sensitivity.
            mixed = mix(constants["opponents"], of_grey(scale, grey)).unsqueeze(2)
            sights.append(Sight(None, mixed * sensitivity))
            continue
        sights.append(Sight(scale, sensitivity))
    return sights


def adapted_luminance(lowpass: Tensor, constants: Mapping[str, Tensor]) -> Tensor:
    """Return the adaptation luminance (B, 1, h, w) in cd/m2, the eye's own light included."""
    seen = mix(constants["luminance_of_cones"], lowpass).clamp_min(0.0)
    return seen + constants["dark_light"]


def sensitivity_at(
    parent: Tensor,
    level: Level,
    relative: Tensor,
    constants: Mapping[str, Tensor],
    chromatic: bool,
) -> Tensor:
    """Return the contrast sensitivity at the local luminance of the parents.

    ``relative``: how many octaves the level's frequency is above the peak in bright light.
    """
    luminance = adapted_luminance(parent, constants).unsqueeze(2)
    dark = torch.log2(1.0 + constants["dim_luminance"] / luminance)
    glare = torch.log2(1.0 + luminance / constants["glare_luminance"])
    faint = torch.log2(1.0 + constants["peak_luminance"] / luminance)
    octaves = relative + constants["peak_exponent"] * faint
    dimmed = constants["achromatic_dimming"] * dark + constants["glare_exponent"] * glare
    shape = bandpass(octaves, constants["band_width"], constants["band_floor"])
    gain = constants["achromatic_gain"] / level.gain
    achromatic = gain * shape * torch.exp2(-dimmed)
    if not chromatic:
        return achromatic
    dim = torch.exp2(-constants["chromatic_dimming"] * dark)
    # Flattened: from planes with one channel, compiled code would make a plane of channels.
    channels = achromatic.flatten(2), (level.sensitivity * dim).flatten(2)
    sensitivity: Tensor = torch.cat(channels, 1).unflatten(2, achromatic.shape[2:])
    return sensitivity
