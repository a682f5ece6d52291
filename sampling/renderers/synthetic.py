"""A renderer without a scene: every pixel's mean and variance are known exactly."""

import numpy as np
from numpy.typing import NDArray

from sampling.renderers.protocol import Samples

# SplitMix64 (Steele, Lea and Flood 2014): increment and the mixer's shifts and factors.
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
MIX = (
    (np.uint64(30), np.uint64(0xBF58476D1CE4E5B9)),
    (np.uint64(27), np.uint64(0x94D049BB133111EB)),
)
LAST_SHIFT = np.uint64(31)


class Synthetic:
    """Samples of ``base``, and with ``probability`` ``event / probability`` more.

    It models a small light that blind sampling hits with ``probability``: mean base + event,
    covariance event event^T (1 - p) / p. The rarer the event, the longer it goes unseen.

    Parameters
    ----------
    base, event
        (H, W, 3), linear BT.709, not negative.
    probability
        (H, W), over 0 and at most 1.
    seed
        Another seed gives other samples.
    """

    def __init__(
        self,
        base: NDArray[np.float64],
        event: NDArray[np.float64],
        probability: NDArray[np.float64],
        seed: int = 0,
    ) -> None:
        height, width = probability.shape
        if base.shape != (height, width, 3) or event.shape != base.shape:
            raise ValueError(
                f"expected base and event of shape ({height}, {width}, 3), "
                f"got {base.shape} and {event.shape}"
            )
        if not ((probability > 0.0) & (probability <= 1.0)).all():
            raise ValueError("expected probabilities over 0 and at most 1")
        self.size = (height, width)
        self._dark = base.reshape(-1, 3).astype(np.float32)
        lit = base + event / probability[..., None]
        self._lit = lit.reshape(-1, 3).astype(np.float32)
        self._probability = probability.reshape(-1)
        self._seed = _mixed(np.array([seed], np.uint64))

    @property
    def mean(self) -> NDArray[np.float64]:
        """(H, W, 3), the expectation of a sample."""
        chance = self._probability[:, None]
        mean = (1.0 - chance) * self._dark.astype(np.float64) + chance * self._lit
        return mean.reshape(*self.size, 3)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(H, W, 3, 3), the covariance of a sample."""
        step = self._lit.astype(np.float64) - self._dark
        chance = (self._probability * (1.0 - self._probability))[:, None, None]
        return (chance * step[:, :, None] * step[:, None, :]).reshape(*self.size, 3, 3)

    def sample(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> Samples:
        """Draw samples ``first[i]`` to ``first[i] + count[i] - 1`` of each of ``pixels``."""
        which = np.repeat(pixels, count)
        # Each pixel has a stream of its own, and k is the position in it.
        stream = np.repeat(_mixed(self._seed + pixels.astype(np.uint64) * GOLDEN), count)
        number = np.arange(len(which)) - np.repeat(np.cumsum(count) - count - first, count)
        bits = _mixed(stream + number.astype(np.uint64) * GOLDEN)
        uniform = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
        hit = uniform < self._probability[which]
        return Samples(which, np.where(hit[:, None], self._lit[which], self._dark[which]))


def _mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return SplitMix64's output for a state."""
    state = state + GOLDEN
    for shift, factor in MIX:
        state = (state ^ (state >> shift)) * factor
    return state ^ (state >> LAST_SHIFT)
