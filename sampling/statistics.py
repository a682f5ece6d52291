"""Statistics of the samples: count, mean and co-moments of every pixel, in bounded memory.

They are the leaves of the paper's tree ("refine cortex representation", Fig. 8). Partial statistics
are merged by the pairwise rule of Chan, Golub and LeVeque 1979, third and fourth moments after
Pebay 2008.
"""

from typing import Self

import numpy as np
from numpy.typing import NDArray

from sampling.renderers import Samples

Plane = NDArray[np.float64]

# Rows and columns of the six co-moments that are kept from the symmetric 3x3 matrix.
FIRST, SECOND = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])

# A run of samples of one pixel is folded in at once, but never across a sample number that is a
# multiple of this. As long as a run is not cut elsewhere, the batch does not change a bit.
PIECE = 2**16

# Samples, and runs of them, that are folded in at once, which bounds memory. Status: choice,
# measured.
AT_ONCE, RUNS_AT_ONCE = 2**17, 2**13


class Statistics:
    """Count, RGB mean and co-moments of the samples of each of ``pixels`` pixels, in float64.

    The order of merging changes only the last bits. A sample that is NaN or infinite in any channel
    is counted in ``drawn`` and ``nonfinite``, and nowhere else.

    Attributes
    ----------
    first
        (P,), int64: the number of the first sample to be drawn.
    drawn, nonfinite
        (P,), int64: samples drawn, and how many of them were not finite.
    mean
        (3, P), R, G, B.
    comoments
        (6, P), sums of (x_i - mean_i) (x_j - mean_j) for RR, RG, RB, GG, GB, BB.
    higher
        (2, P), sums of the third and fourth power of the distance from the mean of (R + G + B) / 3.
    half_count, half_mean
        (P,) and (3, P): count and mean of the even-numbered samples; None where not asked for.
    """

    def __init__(
        self, pixels: int, halves: bool = False, first: NDArray[np.int64] | None = None
    ) -> None:
        self.first = np.zeros(pixels, np.int64) if first is None else first.copy()
        self.drawn = np.zeros(pixels, np.int64)
        self.nonfinite = np.zeros(pixels, np.int64)
        self.mean = np.zeros((3, pixels))
        self.comoments = np.zeros((6, pixels))
        self.higher = np.zeros((2, pixels))
        self.half_count = np.zeros(pixels, np.int64) if halves else None
        self.half_mean = np.zeros((3, pixels)) if halves else None

    @property
    def count(self) -> NDArray[np.int64]:
        """(P,), the number of samples in the mean."""
        return self.drawn - self.nonfinite

    def add(self, samples: Samples) -> None:
        """Fold in the next samples of some pixels; sample numbers continue where they ended.

        Raises
        ------
        ValueError
            Where shapes or pixel numbers do not follow the protocol.
        """
        pixels, radiance = samples
        if radiance.shape != (len(pixels), 3):
            raise ValueError(f"expected radiance of shape ({len(pixels)}, 3), got {radiance.shape}")
        if len(pixels) == 0:
            return
        starts, lengths = _runs(pixels)
        runs = pixels[starts]
        backwards = (runs[1:] < runs[:-1]).any()
        if runs[0] < 0 or runs[-1] >= len(self.drawn) or backwards:
            raise ValueError(f"expected sorted pixel numbers from 0 to {len(self.drawn) - 1}")
        cuts = self._cuts(runs, starts, lengths)
        if len(cuts) > 0:
            starts = np.union1d(starts, cuts)
            lengths = np.diff(starts, append=len(pixels))
        # Whole runs at a time, enough to outweigh the overhead of a call, and never two pieces of
        # one run.
        ends = starts + lengths
        low = 0
        while low < len(starts):
            start = int(starts[low])
            high = max(int(np.searchsorted(ends, start + AT_ONCE, "right")), low + 1)
            high = min(high, low + RUNS_AT_ONCE)
            following = int(np.searchsorted(cuts, start, side="right"))
            if following < len(cuts):
                high = min(high, int(np.searchsorted(starts, cuts[following])))
            some = slice(start, int(ends[high - 1]))
            self._add(pixels[some], radiance[some], starts[low:high] - start, lengths[low:high])
            low = high

    def merge(self, other: Self) -> None:
        """Fold in the statistics of other samples of the same pixels."""
        if len(other.drawn) != len(self.drawn):
            raise ValueError(f"expected {len(self.drawn)} pixels, got {len(other.drawn)}")
        before = self.count.astype(np.float64)
        self._fold(
            slice(None),
            before,
            other.count.astype(np.float64),
            other.mean,
            other.comoments,
            other.higher,
        )
        if (
            self.half_count is not None
            and self.half_mean is not None
            and other.half_count is not None
            and other.half_mean is not None
        ):
            both = self.half_count + other.half_count
            self.half_mean += (other.half_mean - self.half_mean) * (
                other.half_count / np.maximum(both, 1)
            )
            self.half_count = both
        self.drawn += other.drawn
        self.nonfinite += other.nonfinite

    def grey(self) -> bool:
        """Return whether all samples are grey: R, G and B equal in each.

        Means and co-moments are then equal bit for bit, because all three channels take the same
        steps; and one coloured sample tells them apart.
        """
        return all(
            bool((plane == of[0]).all()) for of in (self.mean, self.comoments) for plane in of[1:]
        )

    def covariance(self) -> Plane:
        """Return the unbiased covariance of single samples, (6, P); 0 below two samples."""
        return self.comoments / np.maximum(self.count - 1, 1)

    def state(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
        """Return every array by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @classmethod
    def restored(cls, state: dict[str, NDArray[np.float64] | NDArray[np.int64]]) -> Self:
        """Return the statistics whose `state` this is."""
        statistics = cls(len(state["drawn"]), "half_count" in state)
        for name, value in state.items():
            setattr(statistics, name, value.copy())
        return statistics

    def _cuts(
        self, runs: NDArray[np.int64], starts: NDArray[np.int64], lengths: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return where in the samples a run crosses a multiple of `PIECE`."""
        number = self.first[runs] + self.drawn[runs]
        inside = (number + lengths - 1) // PIECE - number // PIECE
        of = np.repeat(np.arange(len(runs)), inside)
        place = np.arange(len(of)) - np.repeat(np.cumsum(inside) - inside, inside) + 1
        cuts: NDArray[np.int64] = starts[of] + (number[of] // PIECE + place) * PIECE - number[of]
        return cuts

    def _add(
        self,
        pixels: NDArray[np.int64],
        radiance: NDArray[np.float32],
        starts: NDArray[np.int64],
        lengths: NDArray[np.int64],
    ) -> None:
        """Fold in whole runs, given their starts and lengths."""
        runs = pixels[starts]
        # All values are checked at once: single samples only where some value is not finite.
        every = bool(np.isfinite(radiance).all())
        finite = np.ones(1, np.bool_) if every else np.isfinite(radiance).all(1)
        if self.half_count is not None:
            number = np.arange(len(pixels)) - np.repeat(starts - self.drawn[runs], lengths)
            self._add_halves(pixels, radiance, finite & (number % 2 == 0))
        before = (self.drawn[runs] - self.nonfinite[runs]).astype(np.float64)
        self.drawn[runs] += lengths
        if not every:
            np.add.at(self.nonfinite, pixels[~finite], 1)
            pixels, radiance = pixels[finite], radiance[finite]
            if len(pixels) == 0:
                return
            kept = np.isin(runs, pixels)
            before = before[kept]
            starts, lengths = _runs(pixels)
            runs = pixels[starts]
        # Adjacent pixels are accessed much faster as a slice.
        beside = runs[-1] - runs[0] == len(runs) - 1
        where = slice(int(runs[0]), int(runs[-1]) + 1) if beside else runs
        self._fold(where, before, *_reduce(radiance, starts, lengths))

    def _add_halves(
        self, pixels: NDArray[np.int64], radiance: NDArray[np.float32], kept: NDArray[np.bool_]
    ) -> None:
        """Fold in the even-numbered samples."""
        if self.half_count is None or self.half_mean is None or not kept.any():
            return
        pixels, radiance = pixels[kept], radiance[kept]
        starts, lengths = _runs(pixels)
        runs = pixels[starts]
        sums = np.add.reduceat(radiance.T.astype(np.float64), starts, axis=1)
        self.half_count[runs] += lengths
        self.half_mean[:, runs] += (sums - lengths * self.half_mean[:, runs]) / self.half_count[
            runs
        ]

    def _fold(
        self,
        where: NDArray[np.int64] | slice,
        before: Plane,
        added: Plane,
        mean: Plane,
        comoments: Plane,
        higher: Plane,
    ) -> None:
        """Merge moments of ``added`` samples into those of ``before``, pixel by pixel."""
        old_mean, old_comoments = self.mean[:, where], self.comoments[:, where]
        old_higher = self.higher[:, where]
        total = np.maximum(before + added, 1.0)
        step = mean - old_mean
        share = before * added / total
        shift = _scalar(step)
        old_second, second = scalar_second(old_comoments), scalar_second(comoments)
        old_share, share_added = before / total, added / total
        third = shift**3 * share * (old_share - share_added) + 3.0 * shift * (
            old_share * second - share_added * old_second
        )
        fourth = (
            shift**4 * share * (old_share**2 - old_share * share_added + share_added**2)
            + 6.0 * shift**2 * (old_share**2 * second + share_added**2 * old_second)
            + 4.0 * shift * (old_share * higher[0] - share_added * old_higher[0])
        )
        self.higher[:, where] = old_higher + higher + np.stack((third, fourth))
        self.comoments[:, where] = old_comoments + comoments + step[FIRST] * step[SECOND] * share
        self.mean[:, where] = old_mean + step * share_added


def _runs(pixels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where the runs of equal numbers start, and their lengths."""
    starts = np.concatenate(([0], np.flatnonzero(pixels[1:] != pixels[:-1]) + 1))
    return starts, np.diff(starts, append=len(pixels))


def scalar_second(comoments: Plane) -> Plane:
    """Return the second moment of the scalar (R + G + B) / 3 from the co-moments, (6, ...)."""
    rr, rg, rb, gg, gb, bb = comoments
    second: Plane = (rr + gg + bb + 2.0 * (rg + rb + gb)) / 9.0
    return second


def _scalar(colour: Plane) -> Plane:
    """Return (R + G + B) / 3 of (3, ...): the bits of a matrix product depend on the length."""
    scalar: Plane = (colour[0] + colour[1] + colour[2]) / 3.0
    return scalar


def _reduce(
    radiance: NDArray[np.float32], starts: NDArray[np.int64], lengths: NDArray[np.int64]
) -> tuple[Plane, Plane, Plane, Plane]:
    """Return count, mean, co-moments and higher moments of each run of samples.

    They are taken about the run's first sample, so that a constant pixel has exactly zero variance
    and a bright one loses no digits; the differences of single-precision numbers are exact.
    """
    shifted: Plane = radiance.T.astype(np.float64, order="C")
    count = lengths.astype(np.float64)
    origin = shifted[:, starts]
    shifted -= np.repeat(origin, lengths, axis=1)
    mean = np.add.reduceat(shifted, starts, axis=1) / count
    comoments = np.empty((6, len(starts)))
    for row, (one, other) in enumerate(zip(FIRST, SECOND, strict=True)):
        products = np.add.reduceat(shifted[one] * shifted[other], starts)
        comoments[row] = products - count * mean[one] * mean[other]
    diagonal = FIRST == SECOND
    comoments[diagonal] = np.maximum(comoments[diagonal], 0.0)
    scalar = _scalar(shifted)
    centre = _scalar(mean)
    scalar -= np.repeat(centre, lengths)
    square = scalar * scalar
    third = np.add.reduceat(square * scalar, starts)
    fourth = np.add.reduceat(square * square, starts)
    return count, mean + origin, comoments, np.stack((third, fourth))
