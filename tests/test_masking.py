"""The transducers against the reference and their closed forms."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import reference_numbers
from tests.reference import calibrated, paper
from torch_vdm.masking import energy_transducer, masking_energy, signed_transducer

Q = torch.tensor(0.3, dtype=torch.float64)


@given(energy=st.floats(0.0, 1e12))
def test_eq_4_is_the_reference(energy: float) -> None:
    actual = energy_transducer(torch.tensor(energy, dtype=torch.float64)).item()
    assert actual == pytest.approx(paper.transducer(energy), rel=1e-9)


@given(contrast=st.floats(-1e6, 1e6))
def test_signed_is_the_reference(contrast: float) -> None:
    actual = signed_transducer(torch.tensor(contrast, dtype=torch.float64), Q).item()
    assert actual == pytest.approx(calibrated.transducer(contrast, contrast**2, 0.3), rel=1e-9)


def test_all_orientations_of_a_channel_mask_alike() -> None:
    weighted = np.random.default_rng(1).normal(scale=3.0, size=(4, 3, 5, 6))
    expected = calibrated.masking_transducer(weighted, paper.ALL_ON, reference_numbers())
    planes = torch.from_numpy(weighted).transpose(0, 1)[None]
    actual = signed_transducer(planes, Q, masking_energy(planes))
    np.testing.assert_allclose(actual[0].transpose(0, 1).numpy(), expected, rtol=1e-12)


def test_both_are_1_at_threshold() -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    assert energy_transducer(one) == 1.0
    assert signed_transducer(one, Q).item() == pytest.approx(1.0, rel=1e-15)


def test_signed_is_odd_and_has_a_slope_at_zero() -> None:
    contrast = torch.linspace(0.0, 9.0, 50, dtype=torch.float64)
    assert torch.equal(signed_transducer(-contrast, Q), -signed_transducer(contrast, Q))
    zero = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    signed_transducer(zero, Q).backward()
    assert zero.grad is not None
    assert zero.grad.item() == pytest.approx(2.0**0.3)


@pytest.mark.parametrize(
    ("response", "growth"),
    [(lambda v: signed_transducer(v, Q), 0.4), (lambda v: energy_transducer(v * v), 0.2)],
)
def test_growth_far_out(response: Callable[[torch.Tensor], torch.Tensor], growth: float) -> None:
    # A slope of v^-0.6: that of masking in Legge and Foley 1980. Eq. 4: v^0.2.
    one, ten = response(torch.tensor([1e4, 1e5], dtype=torch.float64))
    assert math.log10((ten / one).item()) == pytest.approx(growth, abs=0.01)


def test_gradients_check() -> None:
    contrast = torch.linspace(-3.0, 3.0, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: signed_transducer(v, Q), contrast)
    energy = torch.linspace(0.1, 9.0, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(energy_transducer, energy)
