"""What people saw beside gratings, and that the metric says about the same."""

import math

import numpy as np
import pytest

from benchmarks.people import PPD, Zone, gabor, threshold_on, white_noise, zone_scores, zones
from tests.ladder import TRANSFORMS
from torch_vdm import VDM, Display, Haar, StationaryHaar, Steerable
from torch_vdm.model.cortex import Transform

# The middle of every other zone, so many pixels a side.
SIDE = 100


@pytest.mark.parametrize(
    "transform", [Haar(), StationaryHaar("filter"), Steerable()], ids=lambda t: type(t).__name__
)
def test_noise_that_people_just_do_not_see_scores_about_1(transform: Transform) -> None:
    """SIN3D: a geometric mean of 1 within a factor of 1.35, a spread under half an octave.

    Wanted is a factor of 1.25; a part of a zone has a smaller maximum than all of it, and eight
    zones have a mean that is known to about 7 %.
    """
    some = zones()[::2]
    if not some:
        pytest.skip("no shared data: TORCH_VDM_DATA names its folder")
    inner = slice(SIDE // 2, SIDE // 2 + SIDE)
    parts = [Zone(*(image[..., inner, inner] for image in zone)) for zone in some]
    octaves = np.log2(zone_scores(None, transform, PPD, parts))
    assert abs(octaves.mean()) < math.log2(1.35)
    assert octaves.std() < 0.5


@pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
def test_all_orientations_mask(transform: Transform) -> None:
    """Foley 1994: a mask at right angles, 22 dB over threshold, raises it by 5 to 15 dB."""
    metric = VDM(32.0, Display.xyz(), transform=transform)
    target = gabor(2.0, 0.5)
    alone = threshold_on(metric, 32.0, 0.0 * target, target)
    mask = 10.0 ** ((alone + 22.0) / 20.0) * gabor(2.0, 0.5, 90.0)
    raised = threshold_on(metric, 32.0, mask, target) - alone
    assert 5.0 < raised < 15.0


def test_noise_masks() -> None:
    metric = VDM(32.0, Display.xyz())
    target = gabor(1.2, 0.5)
    alone, hidden = (
        threshold_on(metric, 37.0, contrast * white_noise(12.0), target) for contrast in (0.0, 0.2)
    )
    assert hidden > alone + 5.0
