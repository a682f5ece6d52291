"""What is said of two tests beside one another."""

import numpy as np
import pytest

from torch_vdm.evaluate.statistics import FEWEST, Floats, Paired, compare, interval


def pairs(one: list[float], other: list[float]) -> Floats:
    return np.stack([one, other], 1)


def test_a_difference_is_said_in_words() -> None:
    rng = np.random.default_rng(1)
    one = rng.uniform(3.0, 5.0, 50)
    other = one - 1.4 + 0.8 * rng.standard_normal(50)
    told = compare("A", "B", "max_jnd", pairs(one.tolist(), other.tolist()))
    assert told.lower == int((other < one).sum())
    assert told.interval[0] < told.median < told.interval[1] < 0.0
    low, high = -told.interval[1], -told.interval[0]
    assert told.sentence("Maximum") == (
        f"Maximum: B is better than A, {low:.1f} to {high:.1f} JND less in the median, "
        f"on {told.lower} of 50 frames."
    )
    turned = compare("B", "A", "max_jnd", pairs(other.tolist(), one.tolist()))
    assert turned.sentence("Maximum") == told.sentence("Maximum")


def test_no_difference_is_said_too() -> None:
    rng = np.random.default_rng(2)
    one, other = rng.uniform(1.0, 2.0, (2, 40)).tolist()
    told = compare("A", "B", "max_jnd", pairs(one, other))
    assert "no difference between A and B can be told" in told.sentence("Maximum")
    equal = compare("A", "B", "max_jnd", pairs(one, one))
    assert (equal.median, equal.interval, equal.lower, equal.higher) == (0.0, (0.0, 0.0), 0, 0)
    assert "no difference" in equal.sentence("Maximum")


def test_few_frames_tell_nothing() -> None:
    few = compare("A", "B", "max_jnd", pairs([2.0] * (FEWEST - 1), [1.0] * (FEWEST - 1)))
    assert "5 frames; it takes 6" in few.sentence("Maximum")
    enough = compare("A", "B", "max_jnd", pairs([2.0] * FEWEST, [1.0] * FEWEST))
    assert "B is better than A" in enough.sentence("Maximum")
    one = compare("A", "B", "max_jnd", pairs([1.0], [2.0]))
    assert "1 frame;" in one.sentence("Maximum")


def test_the_interval_is_repeatable_and_covers() -> None:
    rng = np.random.default_rng(3)
    samples = rng.normal(1.0, 1.0, (100, 30))
    bounds = np.array([interval(sample) for sample in samples])
    covered = ((bounds[:, 0] <= 1.0) & (bounds[:, 1] >= 1.0)).mean()
    assert 0.88 <= covered <= 1.0  # nominal 0.95; the median's bootstrap is discrete
    assert interval(samples[0]) == interval(samples[0])
    assert interval(samples[0], seed=1) == pytest.approx(interval(samples[0]), abs=0.2)


def test_drawings_of_many_frames_are_made_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(4).normal(size=500)
    whole = interval(values)
    monkeypatch.setattr("torch_vdm.evaluate.statistics.AT_ONCE", 5000)
    assert interval(values) == whole


def test_ranges_have_the_same_digits() -> None:
    def told(low: float, high: float) -> str:
        return Paired("A", "B", "max_jnd", 9, low, (low, high), 4, 5).sentence("Maximum")

    assert "0.28 to 0.30 JND less" in told(0.28, 0.3)
    assert "12 to 140 JND less" in told(12.0, 140.0)
    assert "-0.20 to +1.50 JND in the median" in told(-0.2, 1.5)
    assert "0.571 to 0.574 JND less" in told(0.571, 0.574)
    assert " 0.57 JND less" in told(0.57, 0.57)
    assert "told, +0.0 JND" in told(0.0, 0.0)
