"""Local contrast and opponents against the reference and closed forms."""

import numpy as np
import pytest
import torch

from tests.conftest import KINDS, make_xyz
from tests.reference import calibrated, paper
from torch_vdm.model.contrast import (
    SML_TO_OPPONENTS,
    adapted,
    local_contrast,
    opponents,
    weber_contrast,
)
from torch_vdm.model.cortex import Haar, StationaryHaar
from torch_vdm.model.quadtree import push

DARK_LIGHT = 0.3
DARK_CONES = torch.from_numpy(paper.cone_dark_light(DARK_LIGHT))
MATRIX = torch.tensor(SML_TO_OPPONENTS, dtype=torch.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_is_the_reference(kind: str) -> None:
    sml = make_xyz(kind, 11, 6, 1)
    pyramid = paper.cortex_filtering(sml)
    cortex = Haar().decompose(torch.from_numpy(sml)[None])
    for level, details in enumerate(cortex.details):
        expected = paper.local_contrast(pyramid, level, DARK_LIGHT)
        adaptation = adapted(cortex.parent_lowpass(level), DARK_CONES).reciprocal()
        size = (details.shape[-2], details.shape[-1])
        contrast = local_contrast(details, push(adaptation, size))
        # The reference puts orientations before channels.
        actual = contrast[0].transpose(0, 1).numpy()
        np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-15)
        expected = paper.opponents(expected, paper.ALL_ON)
        actual = opponents(contrast, MATRIX)[0].transpose(0, 1).numpy()
        np.testing.assert_allclose(actual, expected, rtol=1e-11, atol=1e-14)


def test_contrast_by_the_parent_is_at_most_four() -> None:
    # The bound is met where one of sixteen pixels has all the light.
    sml = torch.zeros(1, 3, 4, 4, dtype=torch.float64)
    sml[..., 0, 0] = 1.0
    cortex = Haar().decompose(sml)
    adaptation = adapted(cortex.parent_lowpass(1), torch.zeros(3)).reciprocal()
    contrast = local_contrast(cortex.details[1], push(adaptation, (2, 2)))
    assert contrast.abs().max() == 4.0


# Light in one pixel alone makes the largest contrast: details and lowpass are sums over pixels.
@pytest.mark.parametrize("transform", [Haar(), StationaryHaar()], ids=str)
@pytest.mark.parametrize(
    "size", [(1, 4), (1, 5), (1, 37), (1, 64), (5, 7), (9, 9), (16, 16), (17, 33)], ids=str
)
def test_light_makes_no_contrast_over_eight_beside_black(
    size: tuple[int, int], transform: Haar | StationaryHaar
) -> None:
    pixels = size[0] * size[1]
    lights = torch.eye(pixels, dtype=torch.float64).view(pixels, 1, *size).expand(-1, 3, -1, -1)
    cortex = transform.decompose(lights, true_means=True)
    for level, details in enumerate(cortex.details):
        adaptation = adapted(cortex.parent_lowpass(level), torch.full((3,), 1e-12)).reciprocal()
        nodes = (details.shape[-2], details.shape[-1])
        contrast = local_contrast(details, push(adaptation, nodes, before=cortex.before[level]))
        assert contrast.abs().max() < 8.0 + 1e-9


def test_grey_contrast_excites_all_three_channels() -> None:
    grey = torch.ones(1, 3, 1, 1, dtype=torch.float64)
    np.testing.assert_allclose(
        opponents(grey, MATRIX).flatten().numpy(), [1.0147, 0.4150, 0.8904], atol=1e-12
    )


def test_weber_contrast_is_the_reference_and_antisymmetric() -> None:
    one, other = make_xyz("random", 6, 9, 1), make_xyz("negative", 6, 9, 2)
    first, second = (
        Haar().decompose(torch.from_numpy(image)[None]).lowpass[0] for image in (one, other)
    )
    expected = calibrated.lowpass_contrast(
        first.flatten().numpy(), second.flatten().numpy(), DARK_LIGHT
    )
    actual = weber_contrast(first, second, DARK_CONES)
    np.testing.assert_allclose(actual.flatten().numpy(), expected, rtol=1e-12)
    assert torch.equal(weber_contrast(second, first, DARK_CONES), -actual)
