"""The display against kornia, and the geometry of viewing against trigonometry."""

import math

import kornia
import numpy as np
import pytest
import torch

from torch_vdm import Display, pixels_per_degree
from torch_vdm.model.display import BRIGHTEST, BT709_TO_XYZ, decode_srgb, encode_srgb

PRIMARIES = torch.tensor(BT709_TO_XYZ, dtype=torch.float64)


def random_image() -> torch.Tensor:
    return torch.rand(2, 3, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_srgb_is_decoded_as_kornia_does() -> None:
    coded = torch.linspace(0.0, 1.0, 512, dtype=torch.float64).expand(1, 3, 1, 512)
    expected = kornia.color.rgb_to_linear_rgb(coded)
    torch.testing.assert_close(decode_srgb(coded), expected, rtol=1e-12, atol=1e-12)


def test_encoding_undoes_decoding() -> None:
    coded = torch.linspace(-0.1, 1.5, 256, dtype=torch.float64)
    # The standard's two rounded ends of the linear part differ by 3e-8.
    torch.testing.assert_close(encode_srgb(decode_srgb(coded)), coded, rtol=0.0, atol=1e-6)


def test_codes_are_those_of_the_light_over_white() -> None:
    light = 50.0 * random_image()
    expected = encode_srgb(light / 100.0)
    for display, image in (
        (Display.linear(200.0), light / 100.0),
        (Display.linear(200.0, exposure=1.0), light / 200.0),
        (Display.xyz(), light),
        (Display.srgb(), expected),
    ):
        torch.testing.assert_close(display.to_code(image), expected)


def test_srgb_to_xyz_is_that_of_kornia() -> None:
    image = random_image()
    expected = 80.0 * kornia.color.rgb_to_xyz(kornia.color.rgb_to_linear_rgb(image))
    actual = Display.srgb(80.0).to_xyz(image, PRIMARIES)
    # The two round the matrix to four and to six digits.
    torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("display", [Display.srgb(250.0), Display.linear(250.0)])
def test_white_is_d65_of_the_stated_luminance(display: Display) -> None:
    white = display.to_xyz(torch.ones(1, 3, 1, 1, dtype=torch.float64), PRIMARIES).flatten()
    np.testing.assert_allclose(white / 250.0, [0.9505, 1.0, 1.089], atol=1e-12)


def test_exposure_is_in_stops() -> None:
    image = random_image()
    for make in (Display.srgb, Display.linear):
        plain, brighter = make(100.0), make(100.0, exposure=3.0)
        torch.testing.assert_close(
            brighter.to_xyz(image, PRIMARIES), 8.0 * plain.to_xyz(image, PRIMARIES)
        )


def test_linear_values_may_exceed_one_and_be_slightly_negative() -> None:
    image = torch.tensor([4.0, -0.01, 0.5], dtype=torch.float64).view(1, 3, 1, 1)
    xyz = Display.linear(100.0).to_xyz(image, PRIMARIES)
    expected = 100.0 * PRIMARIES @ image.flatten()
    torch.testing.assert_close(xyz.flatten(), expected)


def test_xyz_is_taken_as_it_is() -> None:
    image = random_image()
    assert torch.equal(Display.xyz().to_xyz(image, PRIMARIES), image)


@pytest.mark.parametrize("display", [Display.srgb(), Display.linear(), Display.xyz()])
def test_the_largest_floats_stay_finite(display: Display) -> None:
    image = torch.tensor([3e38, -3e38, 1e30]).view(1, 3, 1, 1).requires_grad_()
    xyz = display.to_xyz(image, PRIMARIES.float())
    assert (xyz.abs() <= 2.0 * BRIGHTEST).all()
    (gradient,) = torch.autograd.grad(xyz.sum(), image)
    assert torch.isfinite(gradient).all()


def test_decoding_has_a_gradient_everywhere() -> None:
    coded = torch.tensor([-1.0, -0.055, 0.0, 0.04045, 0.05, 1.0, 2.0], dtype=torch.float64)
    coded.requires_grad_()
    (gradient,) = torch.autograd.grad(decode_srgb(coded).sum(), coded)
    assert torch.isfinite(gradient).all()
    assert (gradient > 0.0).all()


@pytest.mark.parametrize("white", [0.0, -1.0, math.nan, math.inf])
def test_a_white_without_light_is_refused(white: float) -> None:
    with pytest.raises(ValueError, match="luminance of white over 0 cd/m2, got"):
        Display.linear(white)
    with pytest.raises(ValueError, match="exposure within 64 stops"):
        Display.linear(100.0, exposure=math.nan)


def test_pixels_per_degree_is_the_geometry() -> None:
    # 0.5 m from a screen 0.5 m wide with 1000 pixels: a pixel is 0.5 mm.
    diagonal = math.hypot(1000, 500) / 1000 * 0.5 / 0.0254
    expected = 2.0 * 0.5 * math.tan(math.pi / 360.0) / 0.0005
    assert pixels_per_degree((1000, 500), diagonal, 0.5) == pytest.approx(expected, rel=1e-12)


def test_a_screen_without_size_is_refused() -> None:
    with pytest.raises(ValueError, match="positive resolution, diagonal"):
        pixels_per_degree((1920, 0), 24.0, 0.6)
