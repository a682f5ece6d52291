"""The shrunk variance against known ones, where samples have seen nothing and where they have."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sampling import variance
from sampling.renderers import Samples
from sampling.renderers.synthetic import Synthetic
from sampling.statistics import FIRST, SECOND, Statistics
from sampling.variance import SIGNIFICANCE, _unrefuted, pooled_covariance


def drawn(renderer: Synthetic, count: int) -> Statistics:
    height, width = renderer.size
    pixels = np.arange(height * width)
    statistics = Statistics(len(pixels))
    statistics.add(renderer.sample(pixels, 0 * pixels, np.full(len(pixels), count)))
    return statistics


def wall(chance: float, event: float = 0.1, seed: int = 0) -> Synthetic:
    base = np.full((16, 16, 3), 0.3)
    return Synthetic(base, np.full((16, 16, 3), event), np.full((16, 16), chance), seed)


def green(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    own: NDArray[np.float64] = covariance[3]
    return own


@pytest.mark.parametrize(("chance", "count"), [(0.01, 16), (0.001, 64)])
def test_no_variance_seen_is_not_no_variance(chance: float, count: int) -> None:
    renderer = wall(chance)
    statistics = drawn(renderer, count)
    own = statistics.covariance()[3]
    assert (own == 0.0).mean() > 0.7  # most pixels have seen nothing
    shrunk = green(pooled_covariance(statistics, renderer.size))
    truth = renderer.covariance[0, 0, 1, 1]
    assert shrunk.min() > 0.1 * truth
    # The mean of 256 pixels with chance x count events each: a z-test, significance 6e-5.
    events = 256 * chance * count
    assert abs(shrunk.mean() / truth - 1.0) < 4.0 / np.sqrt(events) + 0.1


def test_many_samples_speak_for_themselves() -> None:
    rng = np.random.default_rng(3)
    event = rng.uniform(0.02, 0.3, (16, 16, 1)) * np.ones(3)
    renderer = Synthetic(np.full((16, 16, 3), 0.3), event, np.full((16, 16), 0.5))
    shrunk = pooled_covariance(drawn(renderer, 16000), renderer.size)
    truth = renderer.covariance[..., FIRST, SECOND].transpose(2, 0, 1)
    np.testing.assert_allclose(shrunk, truth, rtol=0.03)


def test_a_pixel_without_noise_beside_noise_is_soon_believed() -> None:
    event = np.zeros((16, 16, 3))
    event[:, 8:] = 0.1
    renderer = Synthetic(np.full((16, 16, 3), 0.3), event, np.full((16, 16), 0.3))
    truth = renderer.covariance[0, 8, 1, 1]
    quiet = [
        green(pooled_covariance(drawn(renderer, count), renderer.size))[:, :8].max() / truth
        for count in (16, 256, 4096)
    ]
    assert quiet[0] < 0.7
    assert quiet[1] < 0.1
    assert quiet[2] < 0.01


def test_a_dark_pixel_beside_a_bright_one_keeps_its_scale() -> None:
    base = np.full((16, 16, 3), 0.001)
    base[:, 8:] = 1.0
    renderer = Synthetic(base, base, np.full((16, 16), 0.3))
    shrunk = green(pooled_covariance(drawn(renderer, 1024), renderer.size))
    truth = renderer.covariance[..., 1, 1]
    # Without scaling by the mean it would be 4 / 1028 of the bright one's, 4000 times the truth.
    assert (shrunk[:, :8] / truth[:, :8]).max() < 10.0


def test_rare_light_is_known_across_the_border_of_a_large_node() -> None:
    """A row of pixels above the middle, lit as those below: they alone in their half of the tree.

    With 1 event in 1000 samples and 500 samples a pixel, five pixels have seen nothing in 8 % of
    runs; without their neighbours across the border they were left at 1e-4 of their variance.
    """
    light = np.zeros((32, 32, 3))
    light[15:22, 10:20] = 0.003
    chance = np.full((32, 32), 0.001)
    found = []
    for seed in range(12):
        renderer = Synthetic(0.0 * light, light, chance, seed)
        shrunk = green(pooled_covariance(drawn(renderer, 500), renderer.size))
        found.append(shrunk[15, 10:20].min() / renderer.covariance[15, 15, 1, 1])
    assert min(found) > 0.1


def test_it_scales_with_the_radiance() -> None:
    samples = wall(0.1).sample(np.arange(256), np.zeros(256, np.int64), np.full(256, 16))
    found = []
    for factor in (1.0, 8.0):  # a power of two: exact
        statistics = Statistics(256)
        scaled = samples.radiance * np.float32(factor)
        statistics.add(Samples(samples.pixels, scaled))
        found.append(pooled_covariance(statistics, (16, 16)))
    np.testing.assert_allclose(found[1], 64.0 * found[0], rtol=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 7)])
def test_any_size_and_no_noise(size: tuple[int, int]) -> None:
    renderer = Synthetic(np.full((*size, 3), 0.2), np.zeros((*size, 3)), np.ones(size))
    shrunk = pooled_covariance(drawn(renderer, 4), size)
    np.testing.assert_array_equal(shrunk, np.zeros((6, *size)))


def test_it_is_a_covariance() -> None:
    rng = np.random.default_rng(5)
    samples = Samples(np.repeat(np.arange(64), 4), rng.random((256, 3)).astype(np.float32))
    statistics = Statistics(64)
    statistics.add(samples)
    shrunk = pooled_covariance(statistics, (8, 8))
    matrices = np.empty((64, 3, 3))
    for row, (one, other) in enumerate(zip(FIRST, SECOND, strict=True)):
        matrices[:, one, other] = matrices[:, other, one] = shrunk[row].reshape(-1)
    assert np.linalg.eigvalsh(matrices).min() > 0.0


def test_a_saturated_colour_does_not_scale_its_parents_variance_without_bound() -> None:
    # Red or green by chance, and never both: some pixels have seen one of them alone, and their
    # other channel is 0 but for rounding.
    size, count = (32, 32), 16
    red, green = np.zeros((*size, 3)), np.zeros((*size, 3))
    red[..., 0], green[..., 1] = 1.0, 0.297
    renderer = Synthetic(red, green - red, np.full(size, 0.5), 3)
    pixels = np.arange(size[0] * size[1])
    statistics = Statistics(len(pixels))
    statistics.add(renderer.sample(pixels, 0 * pixels, 0 * pixels + count))
    pooled = pooled_covariance(statistics, size)[FIRST == SECOND]
    true = renderer.covariance[0, 0].diagonal()
    # No pixel's estimate is over what a single one could see, p (1 - p) at p = 1/2, but for the
    # scale by which its mean may exceed the others'.
    assert (pooled.mean((1, 2)) <= 1.2 * true + 1e-12).all()
    assert (pooled.max((1, 2)) <= 4.0 * true + 1e-12).all()


def test_a_black_background_beside_a_seldom_hit_light_is_known_to_be_black() -> None:
    # A half that one sample in ten lights, and one that is black.
    size, count = (32, 32), 64
    lit = np.zeros((*size, 3))
    lit[:, :16] = 1.0
    renderer = Synthetic(np.zeros_like(lit), lit, np.full(size, 0.1), 5)
    pixels = np.arange(size[0] * size[1])
    statistics = Statistics(len(pixels))
    statistics.add(renderer.sample(pixels, 0 * pixels, 0 * pixels + count))
    pooled = pooled_covariance(statistics, size)[0]
    true = renderer.covariance[0, 0, 0, 0]
    assert pooled[:, :16].mean() == pytest.approx(true, rel=0.1)
    # Blocks of black pixels have not been hit where as many beside them were, hundreds of times;
    # those at the border are still doubted a little.
    assert pooled[:, 16].max() < 1e-3 * true
    assert pooled[:, 18:].max() < 1e-5 * true
    # But a single pixel that has not been hit is not black for that.
    unlit = (statistics.mean[0].reshape(size) == 0.0)[:, :16]
    assert unlit.any()
    assert pooled[:, :16][unlit].min() > 1e-3 * true


def test_a_lamp_in_one_pixel_is_not_believed_of_the_whole_image() -> None:
    """A tenth of one pixel shows a lamp of 3000; the wall's own noise is next to nothing.

    The prior of the whole image has a kurtosis that no pixel can refute by itself: what the nodes
    left of it made the wall's variance ten thousand times the truth and more.
    """
    base, event = np.full((32, 32, 3), 0.3), np.full((32, 32, 3), 0.1)
    chance = np.full((32, 32), 0.5)
    base[3, 4], event[3, 4], chance[3, 4] = 0.0, 3000.0, 0.1
    renderer = Synthetic(base, event, chance, 1)
    found = green(pooled_covariance(drawn(renderer, 1024), renderer.size))
    ratio = found / renderer.covariance[..., 1, 1]
    # Around the lamp some doubt is left.
    assert (ratio < 1.1).mean() > 0.85
    assert ratio[16:, 16:].max() < 1.1
    assert ratio.min() > 0.9
    assert ratio[3, 4] > 0.5


def test_a_prior_is_dropped_only_where_chance_would_not_fall_so_far_under_it() -> None:
    one = np.ones((16, 16))
    # Few expected events, or a variance near the prior: all of it is left.
    for own, events in ((0.0, 1.0), (0.0, 5.0), (0.5, 1e4), (1.0, 1e4), (3.0, 1e4)):
        assert (_unrefuted(own * one, one, events * one, one.size) == 1.0).all()
    # None seen of n: exp(-n), in any of 256 nodes.
    bound = np.log(one.size / SIGNIFICANCE)
    assert (_unrefuted(0.0 * one, one, (bound - 0.1) * one, one.size) > 0.0).all()
    assert (_unrefuted(0.0 * one, one, (bound + 0.1) * one, one.size) == 0.0).all()
    # Of nodes that are like the prior, hardly any is refuted in any image.
    rng = np.random.default_rng(11)
    for events in (4.0, 8.0, 16.0, 32.0):
        seen = rng.poisson(events, (400, 16, 16)) / events
        dropped = [
            bool((_unrefuted(own, one, events * one, one.size) == 0.0).any()) for own in seen
        ]
        assert np.mean(dropped) <= SIGNIFICANCE


@pytest.mark.parametrize("size", [(1, 9), (7, 1), (33, 61), (40, 64)])
@pytest.mark.parametrize("at_once", [1, 100, 700])
def test_a_level_is_the_same_a_few_rows_at_a_time(
    size: tuple[int, int], at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(5)
    event = rng.random((*size, 3))
    renderer = Synthetic(np.full((*size, 3), 0.2), event, np.full(size, 0.2))
    statistics = drawn(renderer, 8)
    whole = pooled_covariance(statistics, size)
    monkeypatch.setattr(variance, "AT_ONCE", at_once)
    np.testing.assert_allclose(pooled_covariance(statistics, size), whole, rtol=1e-9, atol=1e-15)
