"""The transducers against the reference and their closed forms."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.reference import calibrated, paper
from torch_vdm.masking import energy_transducer, signed_transducer

NUMBERS = (0.3, 0.2, 2.0)
Q, S, K = torch.tensor(NUMBERS, dtype=torch.float64)


def psi(contrast: torch.Tensor) -> torch.Tensor:
    return signed_transducer(contrast, Q, S, K)


@given(energy=st.floats(0.0, 1e12))
def test_eq_4_is_the_reference(energy: float) -> None:
    actual = energy_transducer(torch.tensor(energy, dtype=torch.float64)).item()
    assert actual == pytest.approx(paper.transducer(energy), rel=1e-9)


@given(contrast=st.floats(-1e6, 1e6))
def test_signed_is_the_reference(contrast: float) -> None:
    actual = psi(torch.tensor(contrast, dtype=torch.float64)).item()
    assert actual == pytest.approx(calibrated.transducer(contrast, *NUMBERS), rel=1e-9)


def test_both_are_1_at_threshold() -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    assert energy_transducer(one) == 1.0
    assert psi(one).item() == pytest.approx(1.0, rel=1e-15)


def test_signed_is_odd_and_has_a_slope_at_zero() -> None:
    contrast = torch.linspace(0.0, 9.0, 50, dtype=torch.float64)
    assert torch.equal(psi(-contrast), -psi(contrast))
    zero = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    psi(zero).backward()
    assert zero.grad is not None
    assert zero.grad.item() == pytest.approx(0.2 / 2.0 * 1.5**0.3 * 3.0 / 1.2)


@pytest.mark.parametrize(
    ("response", "growth"), [(psi, 0.4), (lambda v: energy_transducer(v * v), 0.2)]
)
def test_growth_far_out(response: Callable[[torch.Tensor], torch.Tensor], growth: float) -> None:
    # psi' falls as v^-0.6: the slope of masking that Legge and Foley 1980 report. Eq. 4: v^0.2.
    one, ten = response(torch.tensor([1e4, 1e5], dtype=torch.float64))
    assert math.log10((ten / one).item()) == pytest.approx(growth, abs=0.01)


def test_a_weak_pedestal_helps_and_a_strong_one_hides() -> None:
    # The dipper: the increment on a pedestal that is as visible as one at threshold without, by
    # bisection. A dip of 4 to 8 dB (Legge and Foley 1980) is that of a whole stimulus, whose parts
    # are met with all pedestals up to the strongest; of one coefficient it is deeper.
    def bisected(pedestal: float) -> float:
        low, high = 0.0, 100.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            ends = psi(torch.tensor([pedestal, pedestal + middle], dtype=torch.float64))
            if ends.diff().item() > 1.0:
                high = middle
            else:
                low = middle
        return 20.0 * math.log10(high)

    assert bisected(0.0) == pytest.approx(0.0, abs=1e-6)
    assert min(bisected(p) for p in (0.3, 0.5, 0.7, 1.0, 1.4)) < -4.0
    assert bisected(10.0) > 6.0


def test_gradients_check() -> None:
    contrast = torch.linspace(-3.0, 3.0, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(psi, contrast)
    energy = torch.linspace(0.1, 9.0, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(energy_transducer, energy)
