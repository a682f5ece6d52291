"""The ask/tell loop: the same run whatever the batch or interruption, and an honest stop."""

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sampling import Report, Request, Sampler, Samples, Settings, rounds
from sampling.prediction import Model
from sampling.renderers.synthetic import Synthetic
from sampling.sampler import AIM, UNLIT
from sampling.statistics import PIECE, Statistics
from sampling.strategies import STRATEGIES
from torch_vdm import VDM, Display, Haar, Observer, StationaryHaar
from torch_vdm.model.cortex import Transform

METRIC = VDM(60.0, Display.linear(100.0))
SIZE = (12, 9)

every_strategy = pytest.mark.parametrize("strategy", tuple(STRATEGIES))


def spotted(seed: int = 0, size: tuple[int, int] = SIZE) -> Synthetic:
    """Return a scene with a noisy spot on a noisy wall."""
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    spot = np.where((x - 3) ** 2 + (y - 4) ** 2 < 8, 0.4, 0.1)[..., None] * np.ones(3)
    return Synthetic(np.full((*size, 3), 0.2), spot, np.full(size, 0.5), seed)


def finished(sampler: Sampler, renderer: Synthetic, at_once: int = 2**20) -> list[Report]:
    reports = list(rounds(sampler, renderer, at_once))
    assert reports[-1].stop_reason is not None
    assert sampler.ask() is None
    return reports


def assert_same_state(one: dict[str, Any], other: dict[str, Any]) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


def true_maximum(image: NDArray[np.float64], mean: NDArray[np.float64], metric: VDM) -> float:
    test, reference = (
        torch.from_numpy(np.moveaxis(plane, -1, 0)[None].copy()) for plane in (image, mean)
    )
    return float(metric(test, reference).max())


@every_strategy
def test_any_batch_gives_the_same_bits(strategy: Any) -> None:
    settings = Settings(strategy=strategy, tolerance=2.0)
    states = []
    for at_once in (2**20, 1000, 7):
        sampler = Sampler(SIZE, METRIC, settings)
        assert len(finished(sampler, spotted(), at_once)) > 1
        states.append(sampler.state())
    assert_same_state(states[0], states[1])
    assert_same_state(states[0], states[2])


@pytest.mark.parametrize("unbiased", [False, True])
def test_interrupted_anywhere_it_continues_bit_for_bit(unbiased: bool) -> None:
    settings = Settings(tolerance=2.0, unbiased=unbiased)
    whole = Sampler(SIZE, METRIC, settings)
    finished(whole, spotted())
    # A new sampler from the state after every part.
    sampler, renderer, parts = Sampler(SIZE, METRIC, settings), spotted(), 0
    while (request := sampler.ask()) is not None:
        part = next(request.parts(300))
        sampler.tell(renderer.sample(part.pixels, part.first, part.count))
        sampler = Sampler.restore(sampler.state(), METRIC)
        parts += 1
    assert parts > 5
    assert_same_state(sampler.state(), whole.state())


@pytest.mark.parametrize("unbiased", [False, True])
def test_a_decision_that_is_given_up_leaves_nothing(unbiased: bool) -> None:
    settings = Settings(tolerance=2.0, unbiased=unbiased)
    whole, renderer = Sampler(SIZE, METRIC, settings), spotted()
    finished(whole, renderer)
    sampler = Sampler(SIZE, METRIC, settings)
    given_up = 0

    def patient_for(looks: int) -> Callable[[], None]:
        left = iter(range(looks))

        def look() -> None:
            if next(left, None) is None:
                raise TimeoutError

        return look

    looks = 0
    while True:
        before = sampler.state()
        try:
            request = sampler.ask(patient_for(looks))
        except TimeoutError:
            given_up, looks = given_up + 1, looks + 1
            assert_same_state(sampler.state(), before)
            continue
        looks = 0
        if request is None:
            break
        sampler.tell(renderer.sample(request.pixels, request.first, request.count))
    assert given_up > 10
    assert_same_state(sampler.state(), whole.state())


def test_rounds_are_told_ended_and_gone_on_with() -> None:
    settings = Settings(tolerance=2.0)
    whole, renderer = Sampler(SIZE, METRIC, settings), spotted()
    finished(whole, renderer)
    sampler = Sampler(SIZE, METRIC, settings)
    drawn, ends, sizes = 0, 0, iter((64, 100, 2**20))

    def told(samples: int) -> None:
        nonlocal drawn
        drawn += samples

    def look() -> None:
        if drawn > 200 * (ends + 1):
            raise TimeoutError

    reports: list[Report] = []
    while not reports or reports[-1].stop_reason is None:
        try:
            for report in rounds(sampler, renderer, lambda: next(sizes, 512), look=look, told=told):
                reports.append(report)  # noqa: PERF402  # what came before an end is kept
        except TimeoutError:
            ends += 1
    assert ends > 5
    assert drawn == whole.count.sum() == reports[-1].samples
    assert_same_state(sampler.state(), whole.state())


def test_the_state_is_plain() -> None:
    sampler = Sampler(SIZE, METRIC, Settings(tolerance=2.0))
    finished(sampler, spotted())
    for value in sampler.state().values():
        assert isinstance(value, np.ndarray | int | float | str | None)
    with pytest.raises(ValueError, match="version"):
        Sampler.restore({**sampler.state(), "version": 0}, METRIC)


def test_asking_again_gives_the_same() -> None:
    sampler, renderer = Sampler(SIZE, METRIC), spotted()
    first, again = sampler.ask(), sampler.ask()
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first.count, again.count)
    assert first.samples == 16 * SIZE[0] * SIZE[1]
    # Half of it told: the other half is left.
    part = next(first.parts(first.samples // 2))
    sampler.tell(renderer.sample(part.pixels, part.first, part.count))
    left = sampler.ask()
    assert left is not None
    assert left.samples == first.samples - part.samples
    assert sampler.report() is None


def test_a_part_that_is_told_twice_is_refused() -> None:
    sampler, renderer = Sampler(SIZE, METRIC), spotted()
    request = sampler.ask()
    assert request is not None
    part = next(request.parts(100))
    samples = renderer.sample(part.pixels, part.first, part.count)
    sampler.tell(samples)
    before = sampler.state()
    beyond = Samples(np.array([SIZE[0] * SIZE[1]]), np.zeros((1, 3), np.float32))
    for wrong in (samples, beyond):
        with pytest.raises(ValueError, match="tell each part once"):
            sampler.tell(wrong)
    assert_same_state(sampler.state(), before)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode], ids=str)
def test_whatever_the_caller_has_switched_off(mode: Any) -> None:
    settings = Settings(tolerance=2.0)
    wanted, sampler = Sampler(SIZE, METRIC, settings), Sampler(SIZE, METRIC, settings)
    finished(wanted, spotted())
    with mode():
        assert len(finished(sampler, spotted())) > 1
    assert_same_state(sampler.state(), wanted.state())


def numbers(request: Request) -> Iterator[tuple[int, int]]:
    for pixel, first, count in zip(request.pixels, request.first, request.count, strict=True):
        for number in range(first, first + count):
            yield int(pixel), number


@pytest.mark.parametrize("at_once", [1, 10, 25, 1000])
def test_parts_make_the_request(at_once: int) -> None:
    request = Request(np.array([1, 4, 9]), np.array([0, 20, 3]), np.array([12, 1, 30]))
    parts = list(request.parts(at_once))
    assert [one for part in parts for one in numbers(part)] == list(numbers(request))
    assert all(part.samples <= at_once or len(part.pixels) == 1 for part in parts)


def test_long_runs_are_cut_at_fixed_numbers() -> None:
    first, count = PIECE - 5, 2 * PIECE + 10
    request = Request(np.array([3]), np.array([first]), np.array([count]))
    cuts = [int(part.first[0]) for part in request.parts(1)]
    assert cuts == [first, PIECE, 2 * PIECE, 3 * PIECE]
    assert sum(part.samples for part in request.parts(1)) == count


def test_a_round_asks_for_as_much_as_lets_the_model_predict_the_aim() -> None:
    size, tolerance = (16, 16), 0.7
    renderer = spotted(size=size)
    sampler = Sampler(size, METRIC, Settings(tolerance=tolerance))
    pilot = sampler.ask()
    assert pilot is not None
    samples = renderer.sample(pilot.pixels, pilot.first, pilot.count)
    sampler.tell(samples)
    following, report = sampler.ask(), sampler.report()
    assert following is not None
    assert report is not None
    statistics = Statistics(256)
    statistics.add(samples)
    model = Model(METRIC, statistics, size)
    assert model.predicted_maximum(tolerance) == report.predicted
    wanted = sampler.count.astype(np.float64).reshape(-1)
    wanted[following.pixels] += following.count
    found = model.largest(wanted.reshape(size)) / model.largest()
    goal = (AIM * tolerance / report.predicted) ** model.exponent
    # Whole samples, and a growth that is known to some percent.
    assert 0.98 < (found / goal) ** (1.0 / model.exponent) <= 1.0


@every_strategy
def test_it_stops_at_its_most_samples(strategy: Any) -> None:
    sampler = Sampler(SIZE, METRIC, Settings(strategy=strategy, tolerance=0.01, max_spp=50))
    report = finished(sampler, spotted())[-1]
    assert report.stop_reason == "max_spp"
    assert not report.converged
    assert sampler.count.max() <= 50


def test_an_image_without_noise_stops_after_the_pilot() -> None:
    renderer = Synthetic(np.full((*SIZE, 3), 0.3), np.zeros((*SIZE, 3)), np.ones(SIZE))
    reports = finished(Sampler(SIZE, METRIC), renderer)
    assert [report.predicted for report in reports] == [0.0]
    assert reports[0].converged


@every_strategy
@pytest.mark.parametrize("size", [(1, 1), (1, 2), (5, 3)])
def test_any_size(strategy: Any, size: tuple[int, int]) -> None:
    sampler = Sampler(size, METRIC, Settings(strategy=strategy, tolerance=3.0))
    report = finished(sampler, spotted(size=size))[-1]
    assert report.converged
    assert report.jnd.shape == size
    assert sampler.image.shape == (*size, 3)


def test_reports_add_up() -> None:
    sampler = Sampler(SIZE, METRIC, Settings(tolerance=2.0))
    reports = finished(sampler, spotted())
    assert [report.round for report in reports] == list(range(1, len(reports) + 1))
    for earlier, later in pairwise(reports):
        assert later.samples == earlier.samples + earlier.forecast
    for report in reports:
        assert report.jnd.max() == pytest.approx(report.predicted, rel=1e-9)
        assert report.spp == report.samples / (SIZE[0] * SIZE[1])
        assert report.over == (report.jnd > 2.0).mean()
    assert reports[-1].samples == sampler.count.sum()
    assert reports[-1].predicted <= 2.0


def test_a_black_image_is_not_believed_at_once() -> None:
    """A light of 1 in 1000 on 16 pixels of a black image: most pilots do not meet it."""
    light = np.zeros((*SIZE, 3))
    light[2:6, 2:6] = 0.003
    missed = 0
    for seed in range(6):
        renderer = Synthetic(0.0 * light, light, np.full(SIZE, 0.001), seed)
        sampler = Sampler(SIZE, METRIC, Settings(tolerance=6.0))
        reports = finished(sampler, renderer)
        missed += reports[0].predicted == 0.0
        assert reports[-1].converged
        assert true_maximum(sampler.image, renderer.mean, METRIC) < 6.0
    assert missed >= 3


def test_a_black_scene_ends() -> None:
    black = np.zeros((*SIZE, 3))
    sampler = Sampler(SIZE, METRIC)
    reports = finished(sampler, Synthetic(black, black, np.ones(SIZE)))
    assert reports[-1].converged
    assert UNLIT <= sampler.count.min() == sampler.count.max() < 4 * UNLIT


class Spoilt:
    """A renderer with samples that are not finite: all of pixel 5, every third of pixel 40."""

    def __init__(self) -> None:
        self.inner = spotted()
        self.size = self.inner.size

    def sample(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> Samples:
        """Draw, and spoil."""
        drawn = self.inner.sample(pixels, first, count)
        number = np.arange(len(drawn.pixels)) - np.repeat(np.cumsum(count) - count - first, count)
        radiance = drawn.radiance.copy()
        radiance[drawn.pixels == 5] = np.nan
        radiance[(drawn.pixels == 40) & (number % 3 == 0)] = np.inf
        return Samples(drawn.pixels, radiance)


@every_strategy
def test_samples_that_are_not_finite_are_left_out_and_told(strategy: Any) -> None:
    sampler = Sampler(SIZE, METRIC, Settings(strategy=strategy, tolerance=8.0))
    *_, report = rounds(sampler, Spoilt())
    assert report.converged
    assert report.nonfinite > 16
    assert np.isfinite(sampler.image).all()
    assert sampler.count.reshape(-1)[5] == 0


def test_the_half_buffers_own_stop() -> None:
    settings = Settings(strategy="halfbuffer", noise_threshold=0.1)
    sampler = Sampler(SIZE, METRIC, settings)
    report = finished(sampler, spotted())[-1]
    assert report.stop_reason == "noise_threshold"


def test_an_unbiased_image_is_of_samples_that_decided_nothing() -> None:
    class Recording(Synthetic):
        drawn: list[tuple[int, int]]

        def sample(
            self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
        ) -> Samples:
            self.drawn += numbers(Request(pixels, first, count))
            return super().sample(pixels, first, count)

    scene = spotted()
    shape = (*SIZE, 3)
    spread = (np.full(shape, 0.2), scene.mean - 0.2, np.full(SIZE, 0.5))
    renderer = Recording(*spread)
    renderer.drawn = []
    sampler = Sampler(SIZE, METRIC, Settings(tolerance=2.0, unbiased=True))
    reports = finished(sampler, renderer)
    assert len(renderer.drawn) == len(set(renderer.drawn)) == reports[-1].samples
    assert 2 * sampler.count.sum() == reports[-1].samples
    assert reports[-2].predicted <= 2.0
    # The second half of every pixel's numbers makes the image.
    half = sampler.count.reshape(-1)
    pixels = np.arange(len(half))
    again = Sampler(SIZE, METRIC, Settings(pilot=int(half.max())))
    again.tell(renderer.sample(pixels, half, half))
    np.testing.assert_array_equal(again.image, sampler.image)


@pytest.mark.parametrize(
    "settings",
    [
        {"tolerance": 0.0},
        {"tolerance": float("nan")},
        {"strategy": "random"},
        {"pilot": 1},
        {"max_spp": 0},
        {"max_spp": 1, "unbiased": True},
        {"noise_threshold": 0.1},
        {"noise_threshold": -1.0, "strategy": "halfbuffer"},
    ],
)
def test_exceptions_of_settings(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        Settings(**settings)


def test_exceptions() -> None:
    with pytest.raises(ValueError, match="height and width"):
        Sampler((0, 4), METRIC)
    with pytest.raises(ValueError, match="linear display"):
        Sampler((4, 4), VDM())


@pytest.mark.parametrize(
    "observer", [Observer.calibrated(), Observer.paper()], ids=lambda o: o.name
)
def test_the_stop_is_honest(observer: Observer) -> None:
    """True maxima of 24 runs, two of them with events of 1 in 50 that a pilot rarely sees.

    With a promise of 95 % kept, fewer than 20 of 24 has a probability of 0.6 %; the seeds are
    fixed. The medians are those that `python -m benchmarks stopping` is held to, a little wider.
    """
    metric = VDM(60.0, Display.linear(100.0), observer)
    ratios = []
    for seed in range(12):
        for event, chance in ((0.1, 0.3), (0.02, 0.02)):
            base = np.full((16, 16, 3), 0.2)
            light = np.full((16, 16, 3), event)
            renderer = Synthetic(base, light, np.full((16, 16), chance), seed)
            sampler = Sampler(renderer.size, metric, Settings(tolerance=2.0))
            assert finished(sampler, renderer)[-1].converged
            ratios.append(true_maximum(sampler.image, renderer.mean, metric) / 2.0)
    assert sum(ratio <= 1.0 for ratio in ratios) >= 20
    assert 0.6 <= np.median(ratios) <= 0.95


def test_takes_a_metric_on_the_cpu_only() -> None:
    with pytest.raises(ValueError, match="expected a metric on the CPU, got one on meta"):
        Sampler(SIZE, VDM(60.0, Display.linear(100.0)).to("meta"))


@pytest.mark.parametrize("transform", [Haar("filter"), StationaryHaar()], ids=repr)
def test_takes_the_papers_transform_only(transform: Transform) -> None:
    metric = VDM(60.0, Display.linear(100.0), transform=transform)
    with pytest.raises(ValueError, match=r"expected a metric on Haar\(\), got"):
        Sampler(SIZE, metric)
