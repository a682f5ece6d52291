"""The Haar transform against the reference, PyWavelets and its own response."""

import math

import numpy as np
import pytest
import pywt
import torch

from tests.conftest import KINDS, make_xyz
from tests.reference import calibrated, paper
from torch_vdm.model.cortex import Haar
from torch_vdm.model.grid import PAPERS


@pytest.mark.parametrize("true_means", [False, True])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "size", [(1, 1), (1, 9), (6, 1), (8, 8), (13, 21), (12, 33), (2, 3), (4, 5)]
)
def test_is_the_reference(kind: str, size: tuple[int, int], true_means: bool) -> None:
    planes = make_xyz(kind, *size, 3)
    reference = calibrated if true_means else paper
    expected = reference.cortex_filtering(planes)
    actual = Haar().decompose(torch.from_numpy(planes)[None], true_means=true_means)
    assert len(actual.details) == len(expected.details)
    if not true_means:
        assert len(actual.details) == paper.level_count(*size)
    rounding = 1e-15 * float(np.abs(planes).max())
    for ours, theirs in zip(actual.details, expected.details, strict=True):
        # The reference puts orientations before channels.
        theirs = np.moveaxis(theirs, 0, 1)
        np.testing.assert_allclose(ours[0].numpy(), theirs, rtol=1e-12, atol=4 * rounding)
    for ours, theirs in zip(actual.lowpass, expected.lowpass, strict=False):
        np.testing.assert_allclose(ours[0].numpy(), theirs, rtol=1e-12, atol=4 * rounding)


def test_is_the_haar_transform_of_pywavelets() -> None:
    planes = np.random.default_rng(2).normal(size=(1, 3, 16, 32))
    actual = Haar().decompose(torch.from_numpy(planes))
    lowpass, scale = planes, 1.0
    for details, ours in zip(reversed(actual.details), reversed(actual.lowpass), strict=True):
        if min(lowpass.shape[-2:]) == 1:
            break  # there PyWavelets pads by another rule
        lowpass, (vertical, horizontal, diagonal) = pywt.dwt2(lowpass, "haar", axes=(-2, -1))
        scale *= 2.0  # PyWavelets' is orthonormal; Eq. 2 divides by 4, not by 2
        for plane, theirs in zip(details.unbind(2), (horizontal, vertical, diagonal), strict=True):
            np.testing.assert_allclose(plane.numpy(), theirs / scale, atol=1e-12)
        np.testing.assert_allclose(ours.numpy(), lowpass / scale, atol=1e-12)


def test_orientations_are_named_as_in_the_paper() -> None:
    x = torch.tensor([1.0, -1.0]).repeat(4).expand(1, 1, 8, 8)
    for image, orientation in ((x, 0), (x.transpose(2, 3), 1), (x * x.transpose(2, 3), 2)):
        finest = Haar().decompose(image).details[-1]
        assert finest.abs().sum((0, 1, 3, 4)).nonzero().flatten().tolist() == [orientation]


@pytest.mark.parametrize("level", range(8))
def test_peak_is_that_of_the_wavelet(level: int) -> None:
    expected_radians, expected_gain = paper.wavelet_peak(2**level)
    frequency, gain = Haar().peak(level)
    assert 2.0 * math.pi * frequency == pytest.approx(expected_radians, rel=1e-9)
    assert gain == pytest.approx(expected_gain, rel=1e-12)


def test_peaks_at_64_pixels_per_degree() -> None:
    # Measured by themselves, before the metric was written.
    frequencies, gains = zip(*(Haar().peak(level) for level in range(6)), strict=True)
    cpd = [64.0 * frequency for frequency in frequencies]
    np.testing.assert_allclose(cpd, [32, 12.5, 6.01, 2.98, 1.49, 0.74], rtol=5e-3)
    np.testing.assert_allclose(gains, [1, 0.770, 0.735, 0.727, 0.725, 0.725], atol=6e-4)


ODD = [(8, 8), (13, 21), (1, 33), (22, 3), (2, 5), (16, 17)]


@pytest.mark.parametrize("size", ODD, ids=str)
def test_every_pixel_has_the_same_weight_in_true_means(size: tuple[int, int]) -> None:
    # What each coefficient is made of: its responses to an impulse in each pixel.
    height, width = size
    impulses = torch.eye(height * width, dtype=torch.float64).view(-1, 1, height, width)
    cortex = Haar().decompose(impulses, true_means=True)
    grid = calibrated.grid_of(height, width)[:0:-1]
    for (rows, columns), lowpass, details in zip(grid, cortex.lowpass, cortex.details, strict=True):
        weights = lowpass[:, 0].view(height, width, rows.nodes(), columns.nodes())
        expected = torch.zeros_like(weights)
        for y in range(rows.nodes()):
            for x in range(columns.nodes()):
                down, across = rows.pixels(y), columns.pixels(x)
                share = 1.0 / (len(down) * len(across))
                expected[down.start : down.stop, across.start : across.stop, y, x] = share
        torch.testing.assert_close(weights, expected)
        # Along a difference no pixel has more than one of a whole node has; along a sum those
        # beside a border stand for the pixels that are not there, and count twice at most.
        if min(rows.nodes(), columns.nodes()) > 1:
            assert details.abs().max() <= 2.0 / (rows.node * columns.node) * (1.0 + 1e-12)
            along_both = details[:, :, 2].abs().max()
            assert along_both <= 1.0 / (rows.node * columns.node) * (1.0 + 1e-12)


@pytest.mark.parametrize("true_means", [False, True])
@pytest.mark.parametrize("size", [(21, 10), (64, 64), (16, 3)])
def test_flat_images_have_no_details(size: tuple[int, int], true_means: bool) -> None:
    cortex = Haar().decompose(torch.full((1, 3, *size), 0.3), true_means=true_means)
    assert not any(details.any() for details in cortex.details)
    assert all((lowpass == 0.3).all() for lowpass in cortex.lowpass)


def test_the_papers_nodes_begin_with_the_image() -> None:
    image = torch.rand(1, 3, 13, 21, dtype=torch.float64)
    printed = Haar().decompose(image)
    assert printed.grid == PAPERS
    assert set(printed.before) == {(0, 0)}
    again = Haar().decompose(image, true_means=True, grid=PAPERS)
    # But for the border, the details of the two grids differ in nothing else.
    inside = (cortex.details[-1][..., :-1, :-1] for cortex in (printed, again))
    torch.testing.assert_close(*inside, rtol=1e-14, atol=1e-15)


def test_is_linear() -> None:
    generator = torch.Generator().manual_seed(1)
    one, other = torch.rand(2, 1, 3, 9, 14, dtype=torch.float64, generator=generator)
    mixed = Haar().decompose(2.0 * one - 3.0 * other)
    parts = Haar().decompose(one), Haar().decompose(other)
    for whole, first, second in zip(mixed.details, *(p.details for p in parts), strict=True):
        torch.testing.assert_close(whole, 2.0 * first - 3.0 * second)
