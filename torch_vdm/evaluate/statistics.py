"""Which of two tests is better, from the same frames of both."""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

# How many times the frames are resampled, and the share of the medians within the interval.
# Status: choice.
DRAWINGS, CONFIDENCE = 4000, 0.95

# With fewer frames nothing can be concluded: five that all agree do so by chance one time in
# sixteen, 2 * 0.5^5 > 1 - CONFIDENCE. Status: derived.
FEWEST = 6

# Numbers that are drawn at once, so that memory is bounded. Status: choice.
AT_ONCE = 2**22


@dataclass(frozen=True)
class Paired:
    """Test ``other`` against test ``one``, by one figure over the frames that both have.

    Attributes
    ----------
    one, other
        Names of the tests.
    figure
        The figure that is compared; less is better.
    frames
        Number of frames.
    median
        Median over the frames of the figure of ``other`` minus that of ``one``.
    interval
        The bootstrap interval of that median, 95 %.
    lower, higher
        On how many frames ``other`` has less, and on how many it has more.
    """

    one: str
    other: str
    figure: str
    frames: int
    median: float
    interval: tuple[float, float]
    lower: int
    higher: int

    def sentence(self, what: str) -> str:
        """Return it as a sentence that begins with ``what``; the figure is in JND."""
        low, high = self.interval
        if self.frames < FEWEST:
            return (
                f"{what}: no difference between {self.one} and {self.other} can be told from "
                f"{counted(self.frames, 'frame')}; it takes {FEWEST}."
            )
        if low <= 0.0 <= high:
            return (
                f"{what}: no difference between {self.one} and {self.other} can be told, "
                f"{_range(low, high, '+')} JND in the median over {self.frames} frames "
                f"({self.other} is lower on {self.lower}, {self.one} on {self.higher})."
            )
        better, worse, least, most, wins = (
            (self.other, self.one, -high, -low, self.lower)
            if high < 0.0
            else (self.one, self.other, low, high, self.higher)
        )
        return (
            f"{what}: {better} is better than {worse}, {_range(least, most)} JND less "
            f"in the median, on {wins} of {self.frames} frames."
        )


def compare(one: str, other: str, figure: str, pairs: Floats, seed: int = 0) -> Paired:
    """Compare two tests by a figure of the frames that both have.

    Parameters
    ----------
    one, other, figure
        Names.
    pairs
        The figure of ``one`` and of ``other`` (frames, 2), of one frame at least.
    seed
        Seed of the bootstrap: the same values give the same interval.
    """
    differences: Floats = pairs[:, 1] - pairs[:, 0]
    return Paired(
        one,
        other,
        figure,
        len(differences),
        float(np.median(differences)),
        interval(differences, seed),
        int((differences < 0.0).sum()),
        int((differences > 0.0).sum()),
    )


def interval(differences: Floats, seed: int = 0) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the median."""
    rng = np.random.default_rng(seed)
    count = len(differences)
    rows = max(1, AT_ONCE // count)
    medians = np.concatenate(
        [
            np.median(differences[rng.integers(0, count, (min(rows, DRAWINGS - done), count))], 1)
            for done in range(0, DRAWINGS, rows)
        ]
    )
    outside = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(medians, (outside, 1.0 - outside))
    return float(low), float(high)


def counted(number: int, what: str) -> str:
    """Return "1 frame" or "2 frames"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def _range(low: float, high: float, sign: str = "") -> str:
    """Return a range with two digits of the smaller number, and more where the ends need them."""
    smallest = min((abs(end) for end in (low, high) if end), default=1.0)
    digits = max(0, 1 - math.floor(math.log10(smallest)))
    for more in range(digits, digits + 3):
        ends = f"{low:{sign}.{more}f}", f"{high:{sign}.{more}f}"
        if ends[0] != ends[1]:
            return " to ".join(ends)
    return f"{low:{sign}.{digits}f}"
