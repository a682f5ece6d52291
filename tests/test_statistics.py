"""Running moments against NumPy's two-pass ones."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sampling.renderers import Samples
from sampling.sampler import Request
from sampling.statistics import FIRST, PIECE, SECOND, Statistics

PIXELS = 7


def draw(seed: int, count: NDArray[np.int64]) -> Samples:
    rng = np.random.default_rng(seed)
    radiance = rng.lognormal(0.0, 1.0, (int(count.sum()), 3)).astype(np.float32)
    return Samples(np.repeat(np.arange(len(count)), count), radiance)


def batches(seed: int, number: int) -> list[Samples]:
    """Return batches in which some pixels have no samples."""
    rng = np.random.default_rng(seed)
    return [draw(seed + n, rng.integers(0, 9, PIXELS)) for n in range(number)]


def of_pixel(parts: list[Samples], pixel: int) -> NDArray[np.float64]:
    return np.concatenate([p.radiance[p.pixels == pixel] for p in parts]).astype(np.float64)


def assert_close(one: Statistics, other: Statistics) -> None:
    np.testing.assert_array_equal(one.drawn, other.drawn)
    np.testing.assert_array_equal(one.nonfinite, other.nonfinite)
    for name in ("mean", "comoments", "higher"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9)


def added(parts: list[Samples], halves: bool = False) -> Statistics:
    statistics = Statistics(PIXELS, halves)
    for part in parts:
        statistics.add(part)
    return statistics


@given(seed=st.integers(0, 999), number=st.integers(1, 5))
def test_moments_are_those_of_all_samples_at_once(seed: int, number: int) -> None:
    parts = batches(seed, number)
    statistics = added(parts)
    for pixel in range(PIXELS):
        samples = of_pixel(parts, pixel)
        assert statistics.count[pixel] == len(samples)
        if len(samples) == 0:
            continue
        np.testing.assert_allclose(statistics.mean[:, pixel], samples.mean(0), rtol=1e-12)
        away = samples - samples.mean(0)
        comoments = (away.T @ away)[FIRST, SECOND]
        np.testing.assert_allclose(statistics.comoments[:, pixel], comoments, rtol=1e-9, atol=1e-12)
        scalar = samples.mean(1) - samples.mean()
        higher = [(scalar**3).sum(), (scalar**4).sum()]
        np.testing.assert_allclose(statistics.higher[:, pixel], higher, rtol=1e-9, atol=1e-9)
        if len(samples) > 1:
            covariance = np.cov(samples.T)[FIRST, SECOND]
            np.testing.assert_allclose(
                statistics.covariance()[:, pixel], covariance, rtol=1e-9, atol=1e-12
            )


@given(seed=st.integers(0, 999), number=st.integers(2, 5))
def test_order_is_irrelevant(seed: int, number: int) -> None:
    parts = batches(seed, number)
    assert_close(added(parts), added(parts[::-1]))


@given(seed=st.integers(0, 999), number=st.integers(2, 5), cut=st.integers(0, 5))
def test_merging_equals_one_pass(seed: int, number: int, cut: int) -> None:
    parts = batches(seed, number)
    merged = added(parts[:cut])
    merged.merge(added(parts[cut:]))
    assert_close(merged, added(parts))


def test_merging_halves_equals_one_pass() -> None:
    count = np.array([4, 2, 0, 6, 2, 8, 4])  # even, so that sample numbers keep their parity
    parts = [draw(1, count), draw(2, count), draw(3, count)]
    merged = added(parts[:1], halves=True)
    merged.merge(added(parts[1:], halves=True))
    at_once = added(parts, halves=True)
    assert merged.half_count is not None
    assert at_once.half_count is not None
    assert merged.half_mean is not None
    assert at_once.half_mean is not None
    np.testing.assert_array_equal(merged.half_count, at_once.half_count)
    np.testing.assert_allclose(merged.half_mean, at_once.half_mean, rtol=1e-12)


def test_halves_are_the_samples_of_even_number() -> None:
    parts = batches(5, 4)
    statistics = added(parts, halves=True)
    assert statistics.half_mean is not None
    assert statistics.half_count is not None
    for pixel in range(PIXELS):
        even = of_pixel(parts, pixel)[::2]
        assert statistics.half_count[pixel] == len(even)
        np.testing.assert_allclose(statistics.half_mean[:, pixel], even.mean(0), rtol=1e-12)


def test_constant_pixels_have_exactly_no_variance() -> None:
    value = np.array([0.1, 1e6, 3e-7], np.float32)
    statistics = Statistics(1)
    for length in (1, 5, 1000):
        statistics.add(Samples(np.zeros(length, np.int64), np.tile(value, (length, 1))))
    np.testing.assert_array_equal(statistics.comoments, 0.0)
    np.testing.assert_array_equal(statistics.mean[:, 0], value.astype(np.float64))


def test_a_bright_pixel_loses_no_digits() -> None:
    # 1e6 or 1e6 + 1 in turns: the variance of n samples is n / (4 (n - 1)).
    radiance = np.full((1000, 3), 1e6, np.float32)
    radiance[::2] += 1.0
    statistics = Statistics(1)
    for part in radiance.reshape(10, 100, 3):
        statistics.add(Samples(np.zeros(100, np.int64), part))
    np.testing.assert_allclose(statistics.covariance(), 250.0 / 999.0, rtol=1e-12)


@pytest.mark.parametrize("first", [0, 70000])
def test_batches_cut_at_pieces_leave_no_trace(first: int) -> None:
    count = np.array([3, 2 * PIECE + 5, 0, PIECE - 3, 9, 1, 70000])
    samples = draw(2, count)
    start = np.full(PIXELS, first)
    whole = Statistics(PIXELS, first=start)
    whole.add(samples)
    pieces = Statistics(PIXELS, first=start)
    request = Request(np.flatnonzero(count), start[count > 0], count[count > 0])
    begin = 0
    for part in request.parts(1000):
        end = begin + part.samples
        pieces.add(Samples(samples.pixels[begin:end], samples.radiance[begin:end]))
        begin = end
    assert begin == count.sum()
    for name, value in whole.state().items():
        np.testing.assert_array_equal(pieces.state()[name], value)
    oracle = of_pixel([samples], 1)
    np.testing.assert_allclose(whole.mean[:, 1], oracle.mean(0), rtol=1e-12)
    np.testing.assert_allclose(whole.covariance()[:, 1], np.cov(oracle.T)[FIRST, SECOND], rtol=1e-9)


def test_samples_that_are_not_finite_are_counted_and_nowhere_else() -> None:
    samples = draw(3, np.full(PIXELS, 8))
    radiance = samples.radiance.copy()
    bad = np.array([0, 3, 16, 17, 18, 19, 20, 21, 22, 23])  # two of pixel 0, all of pixel 2
    radiance[bad, [0, 1, 2, 0, 1, 2, 0, 1, 2, 0]] = [np.nan, np.inf] * 5
    statistics = added([Samples(samples.pixels, radiance)])
    good = np.setdiff1d(np.arange(len(radiance)), bad)
    clean = added([Samples(samples.pixels[good], samples.radiance[good])])
    np.testing.assert_array_equal(statistics.drawn, 8)
    np.testing.assert_array_equal(statistics.nonfinite, [2, 0, 8, 0, 0, 0, 0])
    np.testing.assert_array_equal(statistics.count, clean.count)
    np.testing.assert_array_equal(statistics.mean, clean.mean)
    np.testing.assert_array_equal(statistics.comoments, clean.comoments)


def test_state_round_trips() -> None:
    statistics = added(batches(4, 3), halves=True)
    restored = Statistics.restored(statistics.state())
    for name, value in statistics.state().items():
        np.testing.assert_array_equal(restored.state()[name], value)
    restored.add(draw(9, np.full(PIXELS, 3)))
    assert (statistics.drawn != restored.drawn).all()


def test_a_million_samples_cost_less_than_30_megabytes() -> None:
    samples = draw(1, np.full(1000, 1000))
    statistics = Statistics(1000)
    tracemalloc.start()
    statistics.add(samples)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30e6


@pytest.mark.parametrize(
    ("pixels", "shape"), [([1, 0], (2, 3)), ([0, PIXELS], (2, 3)), ([-1, 0], (2, 3)), ([0], (1, 4))]
)
def test_exceptions(pixels: list[int], shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Statistics(PIXELS).add(Samples(np.array(pixels), np.zeros(shape, np.float32)))


def test_short_pieces_of_a_run_are_folded_in_one_by_one() -> None:
    """A run of five samples, cut after two at a multiple of PIECE: both pieces of one pixel."""
    radiance = np.random.default_rng(0).random((5, 3), np.float32)
    statistics = Statistics(1, first=np.array([PIECE - 2]))
    statistics.add(Samples(np.zeros(5, np.int64), radiance))
    assert statistics.drawn[0] == 5
    np.testing.assert_allclose(statistics.mean[:, 0], radiance.mean(0), rtol=1e-6)
    np.testing.assert_allclose(
        statistics.covariance()[FIRST == SECOND, 0], radiance.var(0, ddof=1), rtol=1e-5
    )
