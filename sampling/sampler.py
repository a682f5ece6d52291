"""The adaptive sampler: ask what to render, tell the results, in rounds (Fig. 8).

It draws nothing itself and knows no renderer. `rounds` is the loop that joins the two.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray

from sampling.prediction import Model
from sampling.renderers import Renderer, Samples
from sampling.statistics import FIRST, PIECE, SECOND, Statistics
from sampling.strategies import LARGEST_GROWTH, SMALLEST_GROWTH, STRATEGIES, HalfBuffer
from sampling.variance import pooled_covariance
from torch_vdm import VDM, Haar
from torch_vdm.model.quadtree import push

Plane = NDArray[np.float64]

StopReason = Literal["tolerance", "noise_threshold", "max_spp"]
StrategyName = Literal["perceptual", "objective", "uniform", "halfbuffer"]

# Version of `state`, raised when an older state would be continued differently.
STATE_VERSION = 9

# Share of the tolerance that a round aims at, since a prediction is not exact. Status: choice.
AIM = 0.98

# An image in which no sample has hit any light may have missed all of it. It is not finished before
# a pixel has so many samples, which grow by this factor per round. Status: choice; a light that 1
# sample in 1000 hits, on four pixels of a black image, is then missed in one run of ten million.
UNLIT, UNLIT_GROWTH = 4096, 4.0


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a user may choose.

    Attributes
    ----------
    strategy
        Where samples go.
    tolerance
        Largest visible difference, in JND, that may be left anywhere in the image.
    max_spp
        Most samples of any one pixel; None: no limit.
    pilot
        Samples of every pixel before the first decision.
    noise_threshold
        The half-buffer's own stop, in the unit of its error; None: stop on ``tolerance``.
    unbiased
        Decide on one set of samples and show another: when the run would stop, the same numbers
        of samples are drawn again, and the image is made of these only.

    Raises
    ------
    ValueError
        Where a number is out of its range.
    """

    strategy: StrategyName = "perceptual"
    tolerance: float = 1.0
    max_spp: int | None = None
    pilot: int = 16
    noise_threshold: float | None = None
    unbiased: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be rendered."""
        if self.strategy not in STRATEGIES:
            raise ValueError(
                f"expected a strategy of {', '.join(STRATEGIES)}, got {self.strategy!r}"
            )
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise ValueError(f"expected a tolerance over 0 JND, got {self.tolerance}")
        if self.pilot < 2:
            raise ValueError(f"expected at least 2 pilot samples, got {self.pilot}")
        if self.max_spp is not None and self.max_spp < (2 if self.unbiased else 1):
            raise ValueError(
                f"expected at least 1 sample per pixel, 2 for an unbiased run, got {self.max_spp}"
            )
        if self.noise_threshold is not None:
            if self.strategy != "halfbuffer":
                raise ValueError("expected the halfbuffer strategy with a noise threshold")
            if not (math.isfinite(self.noise_threshold) and self.noise_threshold > 0.0):
                raise ValueError(f"expected a noise threshold over 0, got {self.noise_threshold}")


@dataclass(frozen=True)
class Request:
    """Samples to draw: numbers ``first[i]`` to ``first[i] + count[i] - 1`` of ``pixels[i]``."""

    pixels: NDArray[np.int64]
    """(N,), sorted, each once."""
    first: NDArray[np.int64]
    """(N,)."""
    count: NDArray[np.int64]
    """(N,), at least 1."""

    @property
    def samples(self) -> int:
        """The number of samples in total."""
        return int(self.count.sum())

    def parts(self, at_once: int) -> Iterator["Request"]:
        """Yield the request in parts of at most about ``at_once`` samples, in order.

        A pixel's run is cut only at multiples of `PIECE`, as `Statistics` cuts it, so that the
        size of a batch does not change a bit of the result. A part may thus be as large as `PIECE`.
        """
        # Where each run is cut: at every multiple of PIECE inside it.
        pieces = (self.first + self.count - 1) // PIECE - self.first // PIECE + 1
        of = np.repeat(np.arange(len(self.pixels)), pieces)
        place = np.arange(len(of)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        low = np.maximum(self.first[of], (self.first[of] // PIECE + place) * PIECE)
        high = np.minimum(
            (self.first + self.count)[of], (self.first[of] // PIECE + place + 1) * PIECE
        )
        ends = np.cumsum(high - low)
        start = 0
        while start < len(of):
            drawn = ends[start - 1] if start else 0
            stop = max(start + 1, int(np.searchsorted(ends, drawn + at_once, side="right")))
            part = slice(start, stop)
            # Pieces of one run that fall into the same part are joined again.
            head = np.flatnonzero(np.diff(of[part], prepend=-1))
            count = np.add.reduceat((high - low)[part], head)
            yield Request(self.pixels[of[part][head]], low[part][head], count)
            start = stop


class Report(NamedTuple):
    """What is known after a round."""

    round: int
    """Rounds done; the pilot is the first."""
    samples: int
    """Samples drawn so far."""
    spp: float
    """The same, per pixel."""
    predicted: float
    """Largest visible difference from the converged image, in JND: at 95 % confidence."""
    over: float
    """Share of pixels that are predicted to be over the tolerance, 0 to 1."""
    jnd: NDArray[np.float64]
    """(H, W), the predicted map, in JND; its maximum is ``predicted``."""
    forecast: int
    """Samples that the model expects still to be needed; 0 when stopped."""
    nonfinite: int
    """Samples that were NaN or infinite, and are not in the image."""
    stop_reason: StopReason | None
    """Why it stopped; None while it goes on."""

    @property
    def converged(self) -> bool:
        """Whether the promise holds: it stopped on its own criterion."""
        return self.stop_reason in ("tolerance", "noise_threshold")


class Sampler:
    """Decides where samples go and when there are enough.

    ``ask`` returns what to draw next, the same until ``tell`` has received all of it, and None once
    the run has stopped. ``tell`` folds samples in. All decisions are made in ``ask``; they depend
    on the samples and settings alone, not on batches.

    Parameters
    ----------
    size
        Height and width in pixels.
    metric
        The metric that judges; its display must be linear, or XYZ, and its transform `Haar`.
    settings
        The user's choices.

    Raises
    ------
    ValueError
        Where the size has a 0, or the metric's display is not linear, its transform not `Haar`, or
        it is not on the CPU.
    """

    def __init__(
        self, size: tuple[int, int], metric: VDM, settings: Settings | None = None
    ) -> None:
        if min(size) < 1:
            raise ValueError(f"expected a height and width of at least 1, got {size}")
        if metric.display.encoding == "srgb":
            raise ValueError("expected a metric with a linear display, got sRGB-coded values")
        if metric.transform != Haar():
            raise ValueError(f"expected a metric on Haar(), got {metric.transform}")
        if (device := metric.summation_exponent.device.type) != "cpu":
            raise ValueError(
                f"expected a metric on the CPU, got one on {device}; move a copy there"
            )
        self.size = (int(size[0]), int(size[1]))
        self.metric = metric
        self.settings = settings or Settings()
        self._strategy = STRATEGIES[self.settings.strategy]
        self._statistics = Statistics(self.size[0] * self.size[1], self._strategy.halves)
        self._target = np.full(self.size[0] * self.size[1], self._pilot(), np.int64)
        self._rounds = 0
        # Why an unbiased run stopped, once it has decided.
        self._decided: StopReason | None = None
        self._report: Report | None = None

    def ask(self, look: Callable[[], None] = lambda: None) -> Request | None:
        """Return what is left to draw of this round, or the next round, or None when stopped.

        ``look`` is called now and then during a decision. What it raises ends the decision without
        a trace: the next ``ask`` starts it again.
        """
        if self._report is not None and self._report.stop_reason is not None:
            return None
        left = self._left()
        if not left.any():
            self._decide(look)
            left = self._left()
            if not left.any():
                return None
        pixels, statistics = np.flatnonzero(left), self._statistics
        return Request(pixels, (statistics.first + statistics.drawn)[pixels], left[pixels])

    def tell(self, samples: Samples) -> None:
        """Fold in samples: the parts of what was asked for, in order.

        Raises
        ------
        ValueError
            Where a pixel has more samples than it was asked for, as when a part is told twice.
        """
        told = np.bincount(samples.pixels, minlength=len(self._target))
        if len(told) > len(self._target) or (told > self._left()).any():
            pixel = int(np.argmax(told[: len(self._target)] > self._left()))
            raise ValueError(
                f"expected the samples that were asked for, got too many of pixel {pixel}; "
                "tell each part once"
            )
        self._statistics.add(samples)

    def report(self) -> Report | None:
        """Return the report of the last decision; None before the pilot is complete."""
        return self._report

    def largest_without(self, part: Statistics, look: Callable[[], None] = lambda: None) -> float:
        """Return the visible difference that leaving out a part of the light makes, JND.

        ``part`` has what is left out of each sample so far; see `Model.largest_without`. ``look``
        is as in `ask`.
        """
        grey = self.grey and part.grey()
        model = Model(self.metric, self._statistics, self.size, look, grey)
        return model.largest_without(part)

    @property
    def grey(self) -> bool:
        """Whether all samples so far are grey, so that one plane is decided on in place of three.

        It changes decisions by rounding only.
        """
        return self._statistics.grey()

    @property
    def image(self) -> Plane:
        """(H, W, 3), the mean of the finite samples, linear BT.709; 0 where there are none."""
        return self._statistics.mean.T.reshape(*self.size, 3).copy()

    @property
    def count(self) -> NDArray[np.int64]:
        """(H, W), how many samples each pixel of the image is made of."""
        return self._statistics.count.reshape(self.size)

    @property
    def variance(self) -> Plane:
        """(H, W, 3), the estimated variance of ``image``."""
        variance: Plane = self.single_variance / np.maximum(self.count, 1)[..., None]
        return variance

    @property
    def single_variance(self) -> Plane:
        """(H, W, 3), the estimated variance of a single sample."""
        single = pooled_covariance(self._statistics, self.size)[FIRST == SECOND]
        return np.moveaxis(single, 0, -1)

    def state(self) -> dict[str, Any]:
        """Return all that a continuation needs: a flat dict of arrays, numbers, strings and None.

        `restore` continues bit for bit, wherever in a round the state was taken.
        """
        report = self._report._asdict() if self._report is not None else {}
        return {
            "version": STATE_VERSION,
            "height": self.size[0],
            "width": self.size[1],
            "rounds": self._rounds,
            "decided": self._decided,
            "target": self._target.copy(),
            **{f"settings.{name}": value for name, value in asdict(self.settings).items()},
            **{f"statistics.{name}": a.copy() for name, a in self._statistics.state().items()},
            **{f"report.{name}": value for name, value in report.items()},
        }

    @classmethod
    def restore(cls, state: dict[str, Any], metric: VDM) -> Self:
        """Return the sampler whose `state` this is; the metric must be as it was.

        Raises
        ------
        ValueError
            Where the state is of another version.
        """
        if state.get("version") != STATE_VERSION:
            raise ValueError(
                f"expected a state of version {STATE_VERSION}, got {state.get('version')}"
            )
        size = (int(state["height"]), int(state["width"]))
        sampler = cls(size, metric, Settings(**under("settings.", state)))
        sampler._rounds = int(state["rounds"])
        sampler._decided = state["decided"]
        sampler._target = np.array(state["target"], np.int64)
        sampler._statistics = Statistics.restored(under("statistics.", state))
        report = under("report.", state)
        sampler._report = Report(**report) if report else None
        return sampler

    def _left(self) -> NDArray[np.int64]:
        return self._target - self._statistics.drawn

    def _pilot(self) -> int:
        return min(self.settings.pilot, self._most() or self.settings.pilot)

    def _most(self) -> int | None:
        """Return the most samples of a pixel before the run must stop; None: any number."""
        most = self.settings.max_spp
        return most // 2 if most is not None and self.settings.unbiased else most

    @torch.inference_mode(False)
    @torch.enable_grad()
    def _decide(self, look: Callable[[], None]) -> None:
        """End a round: predict, then stop, or set how many samples every pixel is to have.

        Placement needs derivatives, even if the caller has switched them off.
        """
        statistics = self._statistics
        model = Model(self.metric, statistics, self.size, look)
        predicted = model.predicted_maximum(self.settings.tolerance)
        totals = model.totals()
        # The boundary images say where the difference is, the simulation how large.
        shares = totals / totals.amax().clamp_min(1e-300)
        pixels = push(shares, self.size, before=model.cortex.grid.before(0))[0, 0].numpy()
        jnd = predicted * pixels ** (1.0 / model.exponent)
        drawn = int((statistics.first + statistics.drawn).sum())
        forecast, reason = 0, self._decided
        if reason is None:
            reason = self._enough(predicted)
        if reason is None:
            wanted = self._wanted(model, predicted)
            target = np.ceil(wanted).astype(np.int64).reshape(-1) + statistics.nonfinite
            target = np.maximum(target, statistics.drawn)
            forecast = int((target - statistics.drawn).sum())
            most = self._most()
            if most is not None:
                target = np.maximum(np.minimum(target, most), statistics.drawn)
            if (target > statistics.drawn).any():
                self._target = target
            else:
                reason, forecast = "max_spp", 0
        if self.settings.unbiased:
            shown = self._decided is not None
            if reason is not None and not shown:
                # The same numbers of samples are drawn again: no decision depended on these.
                self._decided, reason = reason, None
                self._target = statistics.drawn.copy()
                self._statistics = Statistics(
                    len(self._target), self._strategy.halves, first=statistics.drawn
                )
            if not shown:
                forecast = 2 * forecast + int(self._target.sum())
        self._rounds += 1
        self._report = Report(
            round=self._rounds,
            samples=drawn,
            spp=drawn / len(self._target),
            predicted=predicted,
            over=float((jnd > self.settings.tolerance).mean()),
            jnd=jnd,
            forecast=forecast,
            nonfinite=int(statistics.nonfinite.sum()),
            stop_reason=reason,
        )

    def _enough(self, predicted: float) -> StopReason | None:
        """Return why the samples are enough, None where they are not."""
        threshold = self.settings.noise_threshold
        if threshold is None:
            enough = predicted <= self.settings.tolerance and not self._unlit()
            return "tolerance" if enough else None
        noise = HalfBuffer().noise(self._statistics, self.size)
        return "noise_threshold" if noise.max() <= threshold else None

    def _unlit(self) -> bool:
        """Return whether all samples were black, and too few to believe it."""
        statistics = self._statistics
        seen = statistics.count.max()
        return bool(0 < seen < UNLIT and not statistics.mean.any())

    def _wanted(self, model: Model, predicted: float) -> Plane:
        """Return how many finite samples every pixel is to have, (H, W)."""
        threshold = self.settings.noise_threshold
        if threshold is not None:
            noise = HalfBuffer().noise(self._statistics, self.size)
            growth = np.clip((noise / threshold) ** 2, SMALLEST_GROWTH, LARGEST_GROWTH)
            alone: Plane = model.count * np.where(noise > threshold, growth, 1.0)
            return alone
        if self._unlit():
            return UNLIT_GROWTH * model.count
        goal = (AIM * self.settings.tolerance / predicted) ** model.exponent * model.largest()
        wanted = self._strategy.wanted(model, self._statistics, goal)
        if not (wanted > model.count).any():
            # The boundary images show nothing where the simulation does.
            wanted = 2.0 * model.count
        return wanted


def rounds(
    sampler: Sampler,
    renderer: Renderer,
    at_once: int | Callable[[], int] = 2**20,
    *,
    look: Callable[[], None] = lambda: None,
    told: Callable[[int], None] = lambda _: None,
) -> Iterator[Report]:
    """Render until the sampler stops; yield its report after each round.

    Parameters
    ----------
    sampler, renderer
        The sampler decides, the renderer draws.
    at_once
        Samples per call of the renderer, or a function that returns them for each round. It changes
        memory and speed, but no bit of the result.
    look
        Called after each call of the renderer, and now and then within a decision. What it raises
        ends the rounds where they are; started again, they continue from there.
    told
        Called with the number of samples that have just been folded in, before ``look``.
    """
    seen: Report | None = None
    while True:
        request = sampler.ask(look)
        report = sampler.report()
        if report is not None and report is not seen:
            yield report
            seen = report
        if request is None:
            return
        for part in request.parts(at_once if isinstance(at_once, int) else at_once()):
            sampler.tell(renderer.sample(part.pixels, part.first, part.count))
            told(part.samples)
            look()


def under(prefix: str, state: dict[str, Any]) -> dict[str, Any]:
    """Return the entries whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): v for name, v in state.items() if name.startswith(prefix)}
