"""The adaptive sampler: ask what to render, tell what came, in rounds (Fig. 8).

It draws nothing itself and knows no renderer. `rounds` is the loop that joins the two.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from sampling.renderers import Renderer, Samples
from sampling.statistics import PIECE, Statistics
from torch_vdm import VDM

StopReason = Literal["tolerance", "noise_threshold", "max_spp"]
StrategyName = Literal["perceptual", "objective", "uniform", "halfbuffer"]

# What `state` is made of. Raised when an older state would be continued differently.
STATE_VERSION = 1


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
        Decide on one set of samples and show another: when the run has reached its (smaller)
        tolerance, the same numbers of samples are drawn anew, and only these make the image.

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


class Request(NamedTuple):
    """Samples to draw: numbers ``first[i]`` to ``first[i] + count[i] - 1`` of ``pixels[i]``."""

    pixels: NDArray[np.int64]
    """(N,), sorted, each once."""
    first: NDArray[np.int64]
    """(N,)."""
    count: NDArray[np.int64]
    """(N,), at least 1."""

    @property
    def samples(self) -> int:
        """How many samples that is."""
        return int(self.count.sum())

    def parts(self, at_once: int) -> Iterator["Request"]:
        """Yield the request in parts of at most about ``at_once`` samples, in order.

        A pixel's run is cut only at multiples of `PIECE`, so that the size of a batch leaves no
        trace in the bits of the result; a part may thus have up to `PIECE` samples more.
        """


class Report(NamedTuple):
    """What is known after a round."""

    round: int
    """Rounds done; the pilot is the first."""
    samples: int
    """Samples drawn so far."""
    spp: float
    """The same, a pixel."""
    predicted: float
    """Largest visible difference from the converged image, in JND: not exceeded with 95 %."""
    over: float
    """Share of pixels that are predicted over the tolerance, 0 to 1."""
    jnd: NDArray[np.float64]
    """(H, W), the predicted map, in JND; its maximum is ``predicted``."""
    forecast: int
    """Samples that the model expects to be still needed; 0 when stopped."""
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

    ``ask`` gives what to draw next, the same until all of it has been told, and None once it has
    stopped. ``tell`` folds samples in. All decisions fall in ``ask``; they depend on the samples
    and settings alone, not on batches.

    Parameters
    ----------
    size
        Height and width in pixels.
    metric
        Who judges; its display must be linear, or XYZ.
    settings
        What the user chose.

    Raises
    ------
    ValueError
        Where the size has a 0 or the display is not linear in the samples.
    """

    def __init__(
        self, size: tuple[int, int], metric: VDM, settings: Settings | None = None
    ) -> None: ...

    def ask(self) -> Request | None:
        """Return what is left to draw of this round, or the next round, or None when stopped."""

    def tell(self, samples: Samples) -> None:
        """Fold in samples: the parts of what was asked, in order."""

    def report(self) -> Report | None:
        """Return what the last decision saw; None before the pilot is complete."""

    @property
    def image(self) -> NDArray[np.float64]:
        """(H, W, 3), the mean of the finite samples, linear BT.709; 0 where there are none."""

    @property
    def count(self) -> NDArray[np.int64]:
        """(H, W), how many samples the image is made of."""

    @property
    def variance(self) -> NDArray[np.float64]:
        """(H, W, 3), the estimated variance of ``image``."""

    def state(self) -> dict[str, Any]:
        """Return everything that a continuation needs: arrays, numbers, strings, None, flat.

        `restore` continues bit for bit, wherever in a round it was taken.
        """

    @classmethod
    def restore(cls, state: dict[str, Any], metric: VDM) -> Self:
        """Return the sampler whose `state` this is; the metric must be as it was."""


def rounds(sampler: Sampler, renderer: Renderer, at_once: int = 2**20) -> Iterator[Report]:
    """Render until the sampler stops; yield its report after each round.

    ``at_once``: samples asked of the renderer in one call. It changes memory and speed, no bit of
    the result.
    """
