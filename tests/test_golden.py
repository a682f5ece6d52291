"""The committed observer has the thresholds that are committed with it."""

import pytest
import torch

from tests.golden import STIMULI, read, threshold

GOLDEN = read()

# Bisection and rounding, dB; 1 % of a sensitivity is 0.09.
TOLERANCE = 0.03


def test_every_stimulus_has_a_golden_threshold() -> None:
    assert GOLDEN.keys() == STIMULI.keys()


@pytest.mark.parametrize("name", STIMULI)
def test_thresholds_are_golden(name: str) -> None:
    with torch.no_grad():
        assert threshold(STIMULI[name]) == pytest.approx(GOLDEN[name], abs=TOLERANCE)
