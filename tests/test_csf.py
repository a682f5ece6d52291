"""The contrast sensitivity functions against the reference and what is known of them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.reference import calibrated, paper
from torch_vdm.model.csf import bandpass, barten, butterworth


def tensors(*numbers: float) -> list[torch.Tensor]:
    return [torch.tensor(number, dtype=torch.float64) for number in numbers]


@given(frequency=st.floats(1e-3, 64.0), luminance=st.floats(1e-3, 1e6), size=st.floats(0.1, 60.0))
def test_barten_is_the_reference(frequency: float, luminance: float, size: float) -> None:
    actual = barten(*tensors(frequency, luminance, size)).item()
    assert actual == pytest.approx(paper.barten(frequency, luminance, size), rel=1e-9)


@given(frequency=st.floats(1e-3, 64.0), gain=st.floats(1.0, 200.0), order=st.floats(0.5, 3.0))
def test_butterworth_is_the_reference(frequency: float, gain: float, order: float) -> None:
    actual = butterworth(*tensors(frequency, gain, 2.29, order)).item()
    assert actual == pytest.approx(paper.butterworth(frequency, gain, 2.29, order), rel=1e-9)


@given(octaves=st.floats(-12.0, 6.0), width=st.floats(0.3, 3.0), floor=st.floats(0.0, 1.0))
def test_bandpass_is_the_reference(octaves: float, width: float, floor: float) -> None:
    actual = bandpass(*tensors(octaves, width, floor)).item()
    assert actual == pytest.approx(calibrated.band(octaves, width, floor), rel=1e-9)


def test_bandpass_has_a_slope_everywhere() -> None:
    octaves = torch.linspace(-3.0, 3.0, 7, dtype=torch.float64, requires_grad=True)
    bandpass(octaves, *tensors(1.3, 0.5)).sum().backward()
    assert octaves.grad is not None
    assert octaves.grad.isfinite().all()


def test_achromatic_sensitivity_peaks_at_about_4_cpd() -> None:
    # "A peak sensitivity to signals of around 4 cpd" (Section 2).
    frequency = torch.logspace(-1, 1.7, 500, dtype=torch.float64)
    peak = frequency[barten(frequency, *tensors(100.0, 12.0)).argmax()].item()
    assert 2.0 < peak < 6.0


def test_chromatic_sensitivity_is_lowpass() -> None:
    frequency = torch.logspace(-2, 1.7, 100, dtype=torch.float64)
    sensitivity = butterworth(frequency, *tensors(76.0, 2.29, 1.09))
    assert (sensitivity.diff() < 0.0).all()
    # The definition of the cutoff: half the power.
    half = butterworth(*tensors(2.29, 76.0, 2.29, 1.09)).item()
    assert half == pytest.approx(76.0 / np.sqrt(2.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_stays_finite_in_the_dark_and_at_high_frequency(dtype: torch.dtype) -> None:
    luminance = torch.tensor([1e-9, 1e-3, 1.0, 1e6, 1e12], dtype=dtype, requires_grad=True)
    for frequency in (1e-4, 30.0, 500.0):
        sensitivity = barten(torch.tensor(frequency, dtype=dtype), luminance, torch.tensor(12.0))
        (gradient,) = torch.autograd.grad(sensitivity.sum(), luminance)
        assert torch.isfinite(sensitivity).all()
        assert torch.isfinite(gradient).all()
