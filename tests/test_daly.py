"""Daly's VDP against closed forms and its own definition."""

import math

import pytest
import torch
from torch import Tensor

from benchmarks import daly
from torch_vdm import Display

PPD = 60.0


def grating(cpd: float, contrast: float, size: int = 120) -> Tensor:
    x = torch.arange(size, dtype=torch.float64) + 0.5
    wave = torch.cos(2.0 * math.pi * cpd / PPD * x)
    return (100.0 * (1.0 + contrast * wave)).expand(1, 3, size, size).contiguous()


def frequencies(size: int) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(
        torch.fft.fftfreq(size, dtype=torch.float64),
        torch.fft.rfftfreq(size, dtype=torch.float64),
        indexing="ij",
    )
    return x, y


def test_the_filters_sum_to_one() -> None:
    filters = daly.cortex_filters(*frequencies(64))
    assert [len(bands) for bands in filters] == [1, 6, 6, 6, 6, 6]
    total = torch.stack([band for bands in filters for band in bands]).sum(0)
    torch.testing.assert_close(total, torch.ones_like(total))


def test_the_sensitivity_is_the_formula() -> None:
    # Written out at 4 cycles/degree along a row, 0.5 m, 100 cd/m2 and 2 x 2 degrees.
    def curve(rho: float) -> float:
        a = 0.801 * (1.0 + 0.7 / 100.0) ** -0.2
        b = 0.3 * 2.0**0.15
        size = float(((3.23 * (rho**2 * 4.0) ** -0.3) ** 5 + 1.0) ** -0.2)
        rise = float(a) * 0.9 * rho * math.exp(-b * 0.9 * rho)
        return size * rise * math.sqrt(1.0 + 0.06 * math.exp(b * 0.9 * rho))

    expected = 250.0 * min(curve(4.0 / (0.856 * 0.5**0.14)), curve(4.0))
    four, zero, light = (torch.tensor(value, dtype=torch.float64) for value in (4.0, 0.0, 100.0))
    actual = daly.sensitivity(four, zero, light, 4.0, 0.5)
    assert actual.item() == pytest.approx(expected, rel=1e-9)
    # At 45 degrees the frequency counts for 1 / ob.
    part = 4.0 * 0.78 * math.sqrt(0.5) * torch.ones((), dtype=torch.float64)
    oblique = daly.sensitivity(part, part, light, 4.0, 0.5)
    expected = 250.0 * min(curve(4.0 / (0.856 * 0.5**0.14)), curve(4.0 * 0.78))
    assert oblique.item() == pytest.approx(expected, rel=1e-9)


def test_the_threshold_rises_with_a_strong_mask() -> None:
    mask = torch.tensor([0.0, 1.0, 100.0], dtype=torch.float64)
    for octave, slope in ((0, 0.7), (1, 0.8), (5, 1.0)):
        raised = daly.elevation(mask, octave)
        assert raised[0] == 1.0
        assert raised[2].item() == pytest.approx(0.0153 * 39249.8**slope, rel=0.01)


def test_probability_follows_contrast() -> None:
    display, flat = Display.xyz(), grating(4.0, 0.0)
    assert not daly.detection_probability(flat, flat.clone(), PPD, display).any()
    zero, light = torch.zeros((), dtype=torch.float64), torch.tensor(100.0, dtype=torch.float64)
    threshold = 1.0 / daly.sensitivity(zero + 4.0, zero, light, 4.0, 0.5).item()
    faint, just, strong = (
        daly.detection_probability(grating(4.0, factor * threshold), flat, PPD, display)
        for factor in (0.2, 1.0, 5.0)
    )
    # At the peaks: the bands that share a grating have less than 1 - 1/e between them.
    assert faint.max() < 0.01
    assert 0.2 < just.max() < 0.7
    assert strong.max() > 0.99
    assert just.shape == (1, 1, 120, 120)


def test_order_and_batch_do_not_matter() -> None:
    one, other = torch.rand(2, 2, 3, 21, 34, generator=torch.Generator().manual_seed(1))
    together = daly.detection_probability(one, other)
    torch.testing.assert_close(daly.detection_probability(other, one), together)
    alone = daly.detection_probability(one[1:], other[1:])
    torch.testing.assert_close(together[1:], alone)
    assert torch.isfinite(together).all()
