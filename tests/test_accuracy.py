"""The arithmetic of the accuracy benchmark, by closed forms, and how peers are shown a stimulus."""

import math

import numpy as np
import pytest
import torch

from benchmarks.accuracy import LIMIT, STEPS, Array, best_constant, contrast_for, errors_at, judged
from benchmarks.peers import WHITE, clipped, coded
from benchmarks.thresholds import D65, Threshold

STEP = np.array(STEPS)


def power_law(gain_db: float, exponent: float) -> Array:
    """Return values of (gain x contrast)^exponent at the steps."""
    return np.asarray(10.0 ** (exponent * (STEP + gain_db) / 20.0))


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("gain_db", [-20.0, -7.3, 0.0, 4.0, 25.0])
def test_the_contrast_for_a_constant_is_that_of_a_power_law(
    gain_db: float, exponent: float
) -> None:
    # The value is 1 where gain times contrast is 1; beyond the steps too.
    assert contrast_for(1.0, STEP, power_law(gain_db, exponent)) == pytest.approx(
        -gain_db, abs=1e-6
    )


def test_what_never_sees_is_held_to_the_limit() -> None:
    assert contrast_for(1.0, STEP, np.zeros(len(STEP))) == LIMIT
    assert contrast_for(0.0, STEP, power_law(0.0, 2.0)) == -LIMIT


def test_values_that_fall_are_made_monotone() -> None:
    values = np.array([1.0, 0.9, 2.0, 4.0, 8.0])
    found = [contrast_for(constant, STEP, values) for constant in (1.5, 3.0, 6.0)]
    assert found == sorted(found)
    assert contrast_for(4.0, STEP, values) == pytest.approx(6.0, abs=1e-6)


@pytest.mark.parametrize("exponent", [1.0, 2.0])
def test_the_best_constant_is_the_mean_of_the_gains(exponent: float) -> None:
    # Power laws of one exponent: errors are gains less the constant's, whose best is their mean,
    # and the rms error is their standard deviation, whatever the exponent.
    gains = np.array([-5.0, -1.0, 0.0, 2.0, 6.5])
    curves = [(STEP, power_law(gain, exponent)) for gain in gains]
    constant, error = best_constant(curves)
    assert 20.0 * math.log10(constant) / exponent == pytest.approx(gains.mean(), abs=0.02)
    np.testing.assert_allclose(error, gains.mean() - gains, atol=0.02)
    shifted = errors_at(constant * 10.0 ** (exponent * 3.0 / 20.0), curves)
    np.testing.assert_allclose(shifted, error + 3.0, atol=1e-6)


def test_the_scale_of_a_metric_does_not_matter_and_its_better_figure_counts() -> None:
    def row(mechanism: str) -> Threshold:
        return Threshold(0, "a", "", mechanism, 1.0, 1.0, None, 10.0, (0.1,) * 3, "gabor", 0.0)

    rows = [row("achromatic"), row("achromatic"), row("red-green")]
    gains = (1.0, -1.0, 3.0)
    good = [power_law(gain, 1.0) for gain in gains]
    bad = [power_law(4.0 * gain, 1.0) for gain in gains]
    curves = [(STEP, np.stack(both, 1)) for both in zip(bad, good, strict=True)]
    found = judged(curves, rows)
    scaled = judged([(steps, 1e-4 * values) for steps, values in curves], rows)
    assert found["all"] == pytest.approx(np.std(gains), abs=0.02)
    assert scaled["all"] == pytest.approx(found["all"], abs=0.02)
    assert found["achromatic_alone"] == pytest.approx(1.0, abs=0.02)
    assert found["one_gain_a_study"]["red-green"] == pytest.approx(0.0, abs=1e-9)
    assert found["at_the_limit"] == 0


def test_the_background_of_a_peer_is_grey_and_what_it_cannot_show_is_noticed() -> None:
    flat = 30.0 * torch.tensor(D65, dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, 4, 4)
    shown = coded(flat, 30.0)
    # A quarter of the white, coded.
    expected = 1.055 * (1.0 / WHITE) ** (1.0 / 2.4) - 0.055
    torch.testing.assert_close(shown, torch.full_like(shown, expected), rtol=1e-3, atol=1e-3)
    assert not clipped(flat, 30.0)
    assert clipped(5.0 * flat, 30.0)
