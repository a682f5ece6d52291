"""The transducers against the reference and their closed forms."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from tests.conftest import reference_numbers
from tests.reference import calibrated, paper
from torch_vdm.model.masking import energy_transducer, masking_energy, unmasked

Q = torch.tensor(0.3, dtype=torch.float64)


def masked(energy: Tensor, masks: Tensor) -> Tensor:
    return energy * torch.exp2(unmasked(masks, Q))


@given(energy=st.floats(0.0, 1e12))
def test_eq_4_is_the_reference(energy: float) -> None:
    actual = energy_transducer(torch.tensor(energy, dtype=torch.float64)).item()
    assert actual == pytest.approx(paper.transducer(energy), rel=1e-9)


@given(energy=st.floats(0.0, 1e12), masks=st.floats(0.0, 1e12))
def test_signed_is_the_reference(energy: float, masks: float) -> None:
    difference, around = torch.tensor([energy, masks], dtype=torch.float64)
    actual = masked(difference, around).item()
    assert actual == pytest.approx(calibrated.transducer(energy, masks, 0.3), rel=1e-9)


def test_all_orientations_of_both_images_mask_alike() -> None:
    images = np.random.default_rng(1).normal(scale=3.0, size=(2, 4, 3, 5, 6))
    alone = paper.Effects(pooling=False)
    expected = calibrated.masked_differences(images[0], images[1], alone, reference_numbers())
    first, second = (torch.from_numpy(image).transpose(0, 1)[None] for image in images)
    actual = masked((first - second) ** 2, masking_energy(first, second))
    np.testing.assert_allclose(actual[0].transpose(0, 1).numpy(), expected, rtol=1e-12)


def alone(contrast: Tensor) -> Tensor:
    """The difference that a contrast makes beside none."""
    none = torch.zeros_like(contrast)
    planes = contrast.view(-1, 1, 1, 1, 1), none.view(-1, 1, 1, 1, 1)
    left = masked((planes[0] - planes[1]) ** 2, masking_energy(*planes))
    return left.sqrt().view_as(contrast)


def test_both_are_1_at_threshold() -> None:
    one = torch.tensor(1.0, dtype=torch.float64)
    assert energy_transducer(one) == 1.0
    assert alone(one).item() == pytest.approx(1.0, rel=1e-15)


def test_signed_has_a_slope_at_zero() -> None:
    least = torch.tensor(1e-9, dtype=torch.float64)
    assert (alone(least) / least).item() == pytest.approx(2.0**0.3)


@pytest.mark.parametrize(
    ("response", "growth"), [(alone, 0.4), (lambda v: energy_transducer(v * v), 0.2)]
)
def test_growth_far_out(response: Callable[[Tensor], Tensor], growth: float) -> None:
    # A slope of v^-0.6: that of masking in Legge and Foley 1980. Eq. 4: v^0.2.
    one, ten = response(torch.tensor([1e4, 1e5], dtype=torch.float64))
    assert math.log10((ten / one).item()) == pytest.approx(growth, abs=0.01)


@given(
    first=st.floats(-1e3, 1e3),
    second=st.floats(-1e3, 1e3),
    further=st.floats(1.0, 10.0),
)
def test_what_differs_more_is_seen_more(first: float, second: float, further: float) -> None:
    # Masked by itself too: a loss that comes nearer never rises.
    def seen(one: float, other: float) -> float:
        planes = [torch.tensor(v, dtype=torch.float64).view(1, 1, 1, 1, 1) for v in (one, other)]
        return masked((planes[0] - planes[1]) ** 2, masking_energy(*planes)).item()

    away = second + further * (first - second)
    assert seen(away, second) >= seen(first, second) * (1.0 - 1e-12)


def test_gradients_check() -> None:
    energy = torch.linspace(0.1, 9.0, 8, dtype=torch.float64, requires_grad=True)
    masks = torch.linspace(0.0, 90.0, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(masked, (energy, masks))
    assert torch.autograd.gradcheck(energy_transducer, energy)
