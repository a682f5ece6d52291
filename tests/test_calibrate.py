"""The fit to thresholds: it recovers observers that are known, and holds what it should."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from benchmarks.calibrate import (
    DRAWINGS,
    FREE,
    HIGHEST_CONTRAST,
    Model,
    by_mechanism,
    centred,
    fit,
    five_folds,
    predicted,
    studies,
    whole_metric,
)
from benchmarks.thresholds import Threshold, read_thresholds
from torch_vdm import Observer

# torch's forward derivatives use what torch itself has deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script:FutureWarning")

# The synthetic observers' own scatter, dB.
SCATTER = 0.1


@pytest.fixture(autouse=True)
def double() -> object:
    """Fit in float64, as `benchmarks.calibrate.run` does."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def subset(every: int) -> list[Threshold]:
    """Return some rows of the table that the fit uses."""
    rows = [t for t in read_thresholds() if t.stimulus != "disk" and t.mechanism != "mixed"]
    return [t for t in rows if max(map(abs, t.contrast)) <= HIGHEST_CONTRAST][::every]


def times(threshold: Threshold, decibels: float) -> Threshold:
    """Return a threshold with another contrast."""
    factor = 10.0 ** (decibels / 20.0)
    contrast = tuple(factor * c for c in threshold.contrast)
    return dataclasses.replace(threshold, contrast=contrast)


@pytest.mark.parametrize("seed", [1, 2])
def test_recovers_the_parameters_of_a_synthetic_observer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = {name: value for name, (value, _) in FREE.items()}
    # Within the beliefs that the fit has; the band's width is believed most.
    true = {
        name: value * math.exp(min(0.3, FREE[name][1]) * rng.uniform(-1.0, 1.0))
        for name, value in centre.items()
    }
    rows = subset(6)
    observer = Observer.calibrated()
    of_true = predicted(Model(observer, rows, DRAWINGS[:1]), true)
    noise = SCATTER * rng.standard_normal(len(rows))
    synthetic = [times(t, r + n) for t, r, n in zip(rows, of_true, noise, strict=True)]
    found, deviations = fit(Model(observer, synthetic, DRAWINGS[:1]), centre, spread=SCATTER)
    error = {name: math.log(found[name] / true[name]) for name in FREE}
    # The scatter alone gives standard deviations of 0.2 to 2 %.
    assert max(deviations.values()) < 0.03
    for name, value in error.items():
        assert abs(value) < 0.05, name
    assert np.abs(predicted(Model(observer, rows, DRAWINGS[:1]), found) - of_true).max() < 0.5


def test_a_threshold_that_is_twice_as_high_is_missed_by_6_db() -> None:
    rows = subset(40)
    values = {name: value for name, (value, _) in FREE.items()}
    once = predicted(Model(Observer.calibrated(), rows, DRAWINGS[:1]), values)
    doubled = [times(t, 20.0 * math.log10(2.0)) for t in rows]
    twice = predicted(Model(Observer.calibrated(), doubled, DRAWINGS[:1]), values)
    np.testing.assert_allclose(once - twice, 20.0 * math.log10(2.0), atol=0.02)


def test_the_model_is_the_metric() -> None:
    # Bisection: 0.125 dB. The model takes adaptation to be that of the background, and knows no
    # means: up to about 1 dB where a stimulus at its threshold changes them.
    rows = [t for t in subset(25) if max(map(abs, t.contrast)) < 0.1]
    observer = Observer.calibrated()
    values = {name: getattr(observer, name) for name in FREE}
    expected = predicted(Model(observer, rows, DRAWINGS[:1]), values)
    actual = whole_metric(observer, rows, expected, *DRAWINGS[0])
    np.testing.assert_allclose(actual, expected, atol=1.5)
    assert np.median(np.abs(actual - expected)) < 0.25


def test_the_committed_observer_lies_where_the_fit_looks() -> None:
    observer = Observer.calibrated()
    for name, (value, width) in FREE.items():
        assert abs(math.log(getattr(observer, name) / value)) < 3.0 * width, name


def test_folds_keep_conditions_and_studies_together() -> None:
    rows = read_thresholds()
    for folds, key in (
        (five_folds(rows), lambda t: (t.study, t.condition, t.luminance)),
        (studies(rows), lambda t: t.study.removesuffix("_disc")),
    ):
        seen: dict[object, int] = {}
        for row, fold in zip(rows, folds, strict=True):
            assert seen.setdefault(key(row), fold) == fold
    assert set(five_folds(rows)) == set(range(5))
    assert -1 in studies(rows)


def test_gains_of_studies_do_not_count() -> None:
    rows = subset(9)
    residual = np.random.default_rng(3).standard_normal(len(rows))
    of_study = {t.study: float(number) for number, t in enumerate(rows)}
    moved = residual + np.array([of_study[t.study] for t in rows])
    np.testing.assert_allclose(centred(moved, rows), centred(residual, rows), atol=1e-12)
    ones = by_mechanism(np.ones(len(rows)), rows)
    assert ones == pytest.approx(dict.fromkeys(ones, 1.0))
