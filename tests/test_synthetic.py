"""The synthetic renderer against its own distribution."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sampling.renderers.synthetic import Synthetic

SIZE = (3, 4)
PIXELS = 12


def renderer(seed: int = 0) -> Synthetic:
    rng = np.random.default_rng(1)
    chance = rng.uniform(0.05, 0.9, SIZE)
    return Synthetic(rng.uniform(0, 1, (*SIZE, 3)), rng.uniform(0, 1, (*SIZE, 3)), chance, seed)


def drawn(seed: int, first: int, count: int) -> NDArray[np.float32]:
    pixels = np.arange(PIXELS)
    samples = renderer(seed).sample(pixels, np.full(PIXELS, first), np.full(PIXELS, count))
    np.testing.assert_array_equal(samples.pixels, np.repeat(pixels, count))
    return samples.radiance.reshape(PIXELS, count, 3)


def test_a_sample_is_a_function_of_pixel_number_and_seed() -> None:
    whole = drawn(3, 0, 100)
    np.testing.assert_array_equal(drawn(3, 40, 7), whole[:, 40:47])
    alone = renderer(3).sample(np.array([2, 5]), np.array([10, 90]), np.array([3, 1]))
    np.testing.assert_array_equal(alone.radiance[:3], whole[2, 10:13])
    np.testing.assert_array_equal(alone.radiance[3], whole[5, 90])
    assert (drawn(4, 0, 100) != whole).any()


def test_mean_and_covariance_are_as_stated() -> None:
    count = 20000
    samples = drawn(5, 0, count).astype(np.float64)
    truth = renderer(5)
    covariance = truth.covariance.reshape(PIXELS, 3, 3)
    error = samples.mean(1) - truth.mean.reshape(PIXELS, 3)
    z = error / np.sqrt(covariance[:, [0, 1, 2], [0, 1, 2]] / count)
    # One z a pixel (the channels are one event); 12 of them, at a significance of 1e-4 together.
    assert np.abs(z).max() < 4.5
    measured = np.array([np.cov(pixel.T) for pixel in samples])
    # The variance of p (1 - p) from n draws: relatively (1 - 2p)^2 / (p (1 - p) n), at most 3 %.
    np.testing.assert_allclose(measured, covariance, rtol=0.13)


def test_neighbouring_streams_are_independent() -> None:
    hits = drawn(0, 0, 5000)[..., 0].astype(np.float64)
    hits = (hits - hits.mean(1, keepdims=True)) / hits.std(1, keepdims=True)
    between = np.corrcoef(hits) * np.sqrt(5000)
    between = between[np.triu_indices(PIXELS, 1)]
    along = (hits[:, 1:] * hits[:, :-1]).mean(1) * np.sqrt(4999)
    # 78 values of N(0, 1) at a significance of 1e-3 together.
    assert max(np.abs(between).max(), np.abs(along).max()) < 4.4


def test_exceptions() -> None:
    base = np.zeros((2, 2, 3))
    with pytest.raises(ValueError, match="shape"):
        Synthetic(base, np.zeros((2, 3, 3)), np.ones((2, 2)))
    with pytest.raises(ValueError, match="probabilities"):
        Synthetic(base, base, np.zeros((2, 2)))
