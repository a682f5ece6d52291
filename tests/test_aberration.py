"""Chromatic aberration against the reference and the paper's sentence."""

import pytest
import torch

from tests.reference import paper
from torch_vdm import Observer
from torch_vdm.model.aberration import attenuation


def short_wave(frequency: float, observer: Observer) -> float:
    """Return the S cones' share, having seen that the others' is 1."""
    numbers = (frequency, observer.aberration_cutoff, observer.aberration_exponent)
    passed = attenuation(*(torch.tensor(number, dtype=torch.float64) for number in numbers))
    short, *others = passed.tolist()
    assert others == [1.0, 1.0]
    return float(short)


@pytest.mark.parametrize("observer", [Observer.paper(), Observer.calibrated()])
@pytest.mark.parametrize("frequency", [0.1, 1.0, 4.0, 30.0])
def test_is_the_reference(observer: Observer, frequency: float) -> None:
    expected = paper.aberration_factor(
        frequency, observer.aberration_cutoff, observer.aberration_exponent
    )
    assert short_wave(frequency, observer) == pytest.approx(expected, rel=1e-12)


def test_is_what_the_paper_says() -> None:
    # "Sensitivity drops to less than half its original value at 4 cpd and is virtually
    # non-existent at frequencies higher than 8 cpd."
    assert short_wave(4.0, Observer.paper()) < 0.5
    assert short_wave(8.0, Observer.paper()) < 0.05
