"""Chromatic aberration against the reference and the paper's sentence."""

import numpy as np
import pytest
import torch

from tests.reference import paper
from torch_vdm import Observer
from torch_vdm.aberration import attenuate_short_wave, short_wave_attenuation


def attenuation(frequency: float, observer: Observer) -> float:
    numbers = (frequency, observer.aberration_cutoff, observer.aberration_exponent)
    return short_wave_attenuation(
        *(torch.tensor(number, dtype=torch.float64) for number in numbers)
    ).item()


@pytest.mark.parametrize("observer", [Observer.paper(), Observer.calibrated()])
@pytest.mark.parametrize("frequency", [0.1, 1.0, 4.0, 30.0])
def test_is_the_reference(observer: Observer, frequency: float) -> None:
    expected = paper.aberration_factor(
        frequency, observer.aberration_cutoff, observer.aberration_exponent
    )
    assert attenuation(frequency, observer) == pytest.approx(expected, rel=1e-12)


def test_is_what_the_paper_says() -> None:
    # "Sensitivity drops to less than half its original value at 4 cpd and is virtually
    # non-existent at frequencies higher than 8 cpd."
    assert attenuation(4.0, Observer.paper()) < 0.5
    assert attenuation(8.0, Observer.paper()) < 0.05


def test_touches_the_short_wave_cones_alone() -> None:
    details = torch.rand(2, 3, 3, 4, 5)
    attenuated = attenuate_short_wave(details, torch.tensor(0.25))
    assert torch.equal(attenuated[:, 0], 0.25 * details[:, 0])
    assert torch.equal(attenuated[:, 1:], details[:, 1:])
    np.testing.assert_array_equal(details.shape, attenuated.shape)
