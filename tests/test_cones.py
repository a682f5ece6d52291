"""Eq. 1 against the reference, and against NumPy's matrix product."""

import numpy as np
import torch

from tests.conftest import make_xyz
from tests.reference import paper
from torch_vdm.model.cones import XYZ_TO_SML, cone_responses

MATRIX = torch.tensor(XYZ_TO_SML, dtype=torch.float64)


def test_is_the_reference() -> None:
    xyz = make_xyz("negative", 5, 7, 1)
    actual = cone_responses(torch.from_numpy(xyz)[None], MATRIX)[0].numpy()
    np.testing.assert_allclose(actual, paper.cone_fundamentals(xyz), rtol=1e-12, atol=1e-12)


def test_is_a_matrix_product() -> None:
    xyz = make_xyz("random", 5, 7, 1)
    product = np.tensordot(np.array(XYZ_TO_SML), xyz, axes=1)
    actual = cone_responses(torch.from_numpy(xyz)[None], MATRIX)[0].numpy()
    np.testing.assert_allclose(actual, product, rtol=1e-12)


def test_no_blue_light_means_no_short_wave_response() -> None:
    xyz = torch.tensor([60.0, 30.0, 0.0]).view(1, 3, 1, 1)
    assert cone_responses(xyz, MATRIX.float())[0, 0] == 0.0


def test_does_not_follow_autocast() -> None:
    xyz = torch.rand(1, 3, 4, 4)
    expected = cone_responses(xyz, MATRIX.float())
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(cone_responses(xyz, MATRIX.float()), expected)
