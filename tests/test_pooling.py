"""Spatial pooling against the reference and torch's own pooling."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from tests.reference import paper
from torch_vdm.model.pooling import pool
from torch_vdm.model.quadtree import surround


@pytest.mark.parametrize("size", [(1, 1), (1, 4), (2, 2), (5, 7)])
def test_is_the_reference(size: tuple[int, int]) -> None:
    responses = np.random.default_rng(1).normal(size=(3, 3, *size))
    expected = paper.spatial_pooling(responses, paper.ALL_ON)
    actual = pool(surround(torch.from_numpy(responses)[None]))[0].numpy()
    np.testing.assert_allclose(actual, expected, rtol=1e-12, atol=1e-12)


def test_is_the_mean_of_nine_inside() -> None:
    responses = torch.rand(2, 3, 3, 8, 9, dtype=torch.float64)
    expected = functional.avg_pool2d(responses.flatten(0, 2), 3, 1).view(2, 3, 3, 6, 7)
    torch.testing.assert_close(pool(surround(responses))[..., 1:-1, 1:-1], expected)


def test_weights_sum_to_one() -> None:
    flat = torch.full((1, 1, 3, 4, 5), 0.7)
    torch.testing.assert_close(pool(surround(flat)), flat)
