"""The committed observer has the thresholds that are committed with it."""

import pytest
import torch

from tests.golden import CASES, STIMULI, read, threshold

GOLDEN = read()

# Bisection and rounding, dB; 1 % of a sensitivity is 0.09.
TOLERANCE = 0.03


def test_every_case_has_a_golden_threshold() -> None:
    assert list(GOLDEN) == CASES


@pytest.mark.parametrize("case", CASES, ids=", ".join)
def test_thresholds_are_golden(case: tuple[str, str]) -> None:
    name, accuracy = case
    with torch.no_grad():
        assert threshold(STIMULI[name], accuracy) == pytest.approx(GOLDEN[case], abs=TOLERANCE)
