"""Contrast sensitivity before the decomposition: an image as weighted contrast.

The boxes of Fig. 2 from chromatic aberration to contrast sensitivity are applied to the smooth
bands of `torch_vdm.model.cortex.bands`, each relative to its own lowpass and luminance, and the
bands are summed again. Transforms with ``csf="filter"`` use this; their levels then only divide by
their gains.
"""

import itertools
from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.cones import of_grey
from torch_vdm.model.contrast import adapted, local_contrast
from torch_vdm.model.cortex import bands
from torch_vdm.model.level import Level, adapted_luminance, sensitivity_at
from torch_vdm.model.matrix import mix_row
from torch_vdm.model.steps import PLAIN, Steps

# Luminances, in log2 cd/m2, at which the band weights are computed; they are interpolated between
# them. Sensitivities change by less than 3 dB from one to the next. Status: choice.
LUMINANCES = tuple(range(-8, 18))


class Weights(NamedTuple):
    """The weights of the bands of an image, the finest first."""

    passed: Tensor
    """(bands, 3): the fraction of each cone's details that chromatic aberration passes."""
    weights: Tensor
    """(channels, bands): with these the response at the bands' frequencies is the sensitivity."""
    at_luminances: Tensor | None
    """(bands + 1, luminances), where the luminance is local: the factors of A's weights at
    `LUMINANCES`, band by band, and in the last row those of C1 and C2."""


def weights(
    constants: Mapping[str, Tensor], passed: Tensor, bright: Tensor, local: bool, chromatic: bool
) -> Weights:
    """Return the `Weights` of an observer.

    Parameters
    ----------
    constants
        The observer's parameters, ``band_frequencies`` and ``band_weights``.
    passed
        (bands, 3), as in `Weights`.
    bright
        (channels, bands): the contrast sensitivity of all channels at the bands' frequencies; if
        ``local``, that of C1 and C2 in bright light.
    local, chromatic
        Whether sensitivity follows the local luminance, and whether C1 and C2 are simulated.
    """
    frequency = constants["band_frequencies"]
    ones = torch.ones_like(frequency)
    # No matrix products: autocast would round them.
    weighting = (constants["band_weights"] * bright.unsqueeze(1)).sum(2)
    if not local:
        return Weights(passed, weighting, None)
    # Of the light alone: the eye's own light is added again later.
    luminances = torch.exp2(ones.new_tensor(LUMINANCES)) - constants["dark_light"]
    grey = luminances * constants["cones"].sum(1, keepdim=True)
    at_bands = (part[..., None, None] for part in (ones, frequency, ones, bright))
    level = Level(*at_bands)
    relative = torch.log2(level.frequency / constants["peak_frequency"])
    found = sensitivity_at(grey[None, :, None], level, relative, constants, chromatic)
    sensitivity = found[0, :, :, 0]
    achromatic = (constants["band_weights"][..., None] * sensitivity[0]).sum(1)
    dim = sensitivity[-1, 0] / bright[-1, 0]
    if not chromatic:
        weighting = weighting[:0]
    table = torch.cat((achromatic, dim[None]))
    return Weights(passed, torch.cat((ones[None], weighting)), table)


def weighted_contrast(
    planes: Tensor,
    weighting: Weights,
    constants: Mapping[str, Tensor],
    coarser: Tensor | None = None,
    finest: int = 0,
    grey: Tensor | None = None,
    steps: Steps = PLAIN,
) -> Tensor:
    """Return the weighted contrast of A, C1, C2, 1 at threshold: (B, channels, H, W).

    ``planes`` are cone planes (B, 3, H, W). The scales go from ``finest`` to the coarsest, or to
    the one at which ``coarser`` is the sum of the rest. With ``grey`` (3,) there is one plane
    (B, 1, H, W), and the cone planes are ``grey`` times it.
    """
    eye = constants["dark_cones"], constants["opponents"]
    of_light = {name: constants[name] for name in ("luminance_of_cones", "dark_light")}
    table = weighting.at_luminances
    seen: list[Tensor] = []
    here, last = planes, (1, 1) if coarser is None else _size(coarser)
    for scale in itertools.count(finest):
        if _size(here) == last:
            break
        some = slice(0, 2) if scale == 0 else slice(scale + 1, scale + 2)
        at_places = None if table is None else torch.cat((table[some], table[-1:]))
        own = Weights(weighting.passed[some].clone(), weighting.weights[:, some].clone(), at_places)
        contrast_of = partial(
            _of_scale,
            finest=scale == 0,
            weighting=own,
            of_light=of_light,
            eye=eye,
            grey=grey,
            steps=steps,
        )
        contrast, here = steps.strips(contrast_of, here)
        seen.append(contrast)
    if coarser is not None:
        seen.append(coarser)
    if not seen:  # one pixel
        return 0.0 * planes[:, :1].expand(-1, len(constants["opponents"]), -1, -1)
    return bands.gathered(seen, steps)


def _of_scale(
    plane: Tensor,
    finest: bool,
    weighting: Weights,
    of_light: dict[str, Tensor],
    eye: tuple[Tensor, Tensor],
    grey: Tensor | None,
    steps: Steps,
) -> tuple[Tensor, Tensor]:
    """Return the weighted contrast of a scale's bands, and the lowpass that remains."""
    planes, around, lowpass = bands.parted(plane, finest, steps)
    passed, weights_of_bands, table = weighting
    at_places = None
    if table is not None:
        at_places = steps(band_sensitivity, of_grey(lowpass, grey), table, of_light)
        at_places = bands.expanded(at_places, _size(around), steps)
    of_bands = passed, weights_of_bands, at_places
    seen: Tensor = steps(band_contrast, around, planes, *of_bands, *eye, grey)
    return seen, lowpass


def band_sensitivity(lowpass: Tensor, table: Tensor, of_light: Mapping[str, Tensor]) -> Tensor:
    """Return the rows of a table at the local luminance, (B, rows, h, w).

    ``lowpass`` is (B, 3, h, w); ``table`` is given at `LUMINANCES`, and linear between them.
    """
    seen = adapted_luminance(lowpass, of_light)
    last = len(LUMINANCES) - 1
    place = (torch.log2(seen[:, 0]) - LUMINANCES[0]).clamp(0.0, last)
    low = place.detach().floor().clamp_max(last - 1.0)
    index, rest = low.long(), place - low
    # Columns are selected: indexing with a tensor of any shape takes four times as long.
    before, after = (
        table.index_select(1, column.flatten()).unflatten(1, place.shape)
        for column in (index, index + 1)
    )
    return torch.lerp(before, after, rest).transpose(0, 1)


def band_contrast(
    around: Tensor,
    scale: tuple[Tensor, ...],
    passed: Tensor,
    weights_of_bands: Tensor,
    at_places: Tensor | None,
    dark_cones: Tensor,
    matrix: Tensor,
    grey: Tensor | None = None,
) -> Tensor:
    """Return the weighted contrast (B, channels, h, w) of the n bands (B, 3, h, w) of a scale.

    ``around`` (B, 3, h, w) is what the eye is adapted to, ``passed`` (n, 3) the fraction that
    chromatic aberration passes, and ``weights_of_bands`` is (channels, n). Where the weights are
    local, ``at_places`` (B, n + 1, h, w) multiplies those of A and, with its last row, those of C1
    and C2. ``grey`` is as in `weighted_contrast`.
    """
    adaptation = 1.0 / adapted(of_grey(around, grey), dark_cones)
    of_one = of_grey(adaptation, grey).unbind(1)
    seen: list[Tensor] = []
    for number, band in enumerate(scale):
        mixing = matrix * passed[number] * weights_of_bands[:, number, None]
        if grey is None:
            contrast = local_contrast(band.unsqueeze(2), adaptation).squeeze(2).unbind(1)
            channels = [mix_row(row, contrast) for row in mixing]
        else:
            channels = [mix_row(row, of_one) * band[:, 0] for row in mixing]
        if at_places is not None:  # A's separately: they follow the luminance band by band
            channels[0] = channels[0] * at_places[:, number]
        seen = [a + b for a, b in zip(seen, channels, strict=True)] if seen else channels
    if at_places is not None:
        seen[1:] = [colour * at_places[:, -1] for colour in seen[1:]]
    return torch.stack(seen, 1)


def _size(plane: Tensor) -> tuple[int, int]:
    return plane.shape[-2], plane.shape[-1]
