"""The tree of variances and the boundary images against impulses and plain loops."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sampling.boundary import QUARTILE, _quarter, boundaries, detail_variances
from torch_vdm import Haar
from torch_vdm.model.cortex import Cortex

SIZES = [(1, 2), (2, 2), (8, 8), (5, 7), (3, 1), (6, 11), (9, 12)]


@pytest.mark.parametrize("true_means", [False, True])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_variances_are_those_of_a_linear_map(height: int, width: int, true_means: bool) -> None:
    variance = torch.rand(1, 1, height, width, dtype=torch.float64)
    # The response to an impulse in each pixel: what each coefficient is made of.
    impulses = torch.eye(height * width, dtype=torch.float64).view(-1, 1, height, width)
    found = detail_variances(variance, true_means)
    expected = [
        (detail**2 * variance.view(-1, 1, 1, 1, 1)).sum(0, keepdim=True)
        for detail in Haar().decompose(impulses, true_means=true_means).details
    ]
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        # Where all have the same, one orientation stands for them.
        torch.testing.assert_close(one.expand_as(other), other, rtol=1e-12, atol=1e-15)


def test_an_interior_node_has_a_sixteenth_of_its_children() -> None:
    variance = torch.rand(2, 3, 12, 12, dtype=torch.float64)
    *_, coarse, fine = detail_variances(variance, true_means=True)
    # Their nodes, of 2 and of 4 pixels, begin with the image.
    for level, node, begin in ((fine, 2, 2), (coarse, 4, 4)):
        block = variance[:, :, begin : begin + node, begin : begin + node].sum((-2, -1))
        for orientation in range(3):
            torch.testing.assert_close(
                level.expand(-1, -1, 3, -1, -1)[:, :, orientation, 1, 1], block / node**4
            )


def made(seed: int) -> tuple[Cortex, tuple[Tensor, ...], Tensor]:
    generator = torch.Generator().manual_seed(seed)
    plane = torch.rand(1, 3, 8, 8, generator=generator, dtype=torch.float64)
    noise = 0.1 * torch.rand(1, 3, 8, 8, generator=generator, dtype=torch.float64)
    return (
        Haar().decompose(plane, true_means=True),
        detail_variances(noise, true_means=True),
        noise.mean((-2, -1), keepdim=True) / 64,
    )


@pytest.mark.parametrize("signed", [False, True])
def test_boundaries_lie_at_the_quartiles(signed: bool) -> None:
    cortex, variances, mean_variance = made(1)
    lower, upper = boundaries(cortex, variances, mean_variance, QUARTILE, signed)
    for level in range(len(cortex.details)):
        numbers = zip(
            cortex.details[level].flatten().tolist(),
            variances[level].expand_as(cortex.details[level]).flatten().tolist(),
            lower.details[level].flatten().tolist(),
            upper.details[level].flatten().tolist(),
            strict=True,
        )
        for detail, variance, low, high in numbers:
            margin = QUARTILE * math.sqrt(variance)
            if signed:
                expected = detail - margin, detail + margin
            else:
                sign = math.copysign(1.0, detail)
                expected = (
                    sign * max(abs(detail) - margin, 0.0),
                    sign * (abs(detail) + margin),
                )
            assert (low, high) == pytest.approx(expected, rel=1e-12, abs=1e-15)
        torch.testing.assert_close(lower.lowpass[level], cortex.lowpass[level])
        torch.testing.assert_close(upper.lowpass[level], cortex.lowpass[level])


def test_half_of_a_normal_distribution_lies_within_the_quartiles() -> None:
    rng = np.random.default_rng(2)
    inside = np.abs(rng.standard_normal(40000)) < QUARTILE
    assert abs(inside.mean() - 0.5) < 4.0 * 0.5 / math.sqrt(40000)  # z-test, significance 6e-5


@pytest.mark.parametrize("signed", [False, True])
def test_without_variance_the_boundaries_are_the_image(signed: bool) -> None:
    cortex, variances, mean_variance = made(3)
    nothing = tuple(torch.zeros_like(v) for v in variances)
    for boundary in boundaries(cortex, nothing, 0.0 * mean_variance, QUARTILE, signed):
        for one, other in zip(boundary.details, cortex.details, strict=True):
            torch.testing.assert_close(one, other, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("size", [(2, 2), (64, 32), (10, 514)], ids=str)
def test_quarters_are_pytorchs_bit_for_bit(size: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(3)
    nodes = torch.rand(1, 3, *size, generator=generator) ** 9
    expected = torch.nn.functional.avg_pool2d(nodes, 2) * 0.25
    assert torch.equal(_quarter(nodes), expected)
    leaf = nodes.clone().requires_grad_(True)
    assert torch.equal(_quarter(leaf).detach(), expected)
