"""A summary of all frames, from one pass over the results."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from torch_vdm.evaluate import statistics
from torch_vdm.evaluate.figures import FIGURES
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.statistics import Floats, Paired

# Skipped frames whose reasons are printed. Status: choice.
NAMED = 5


@dataclass
class Overview:
    """All frames of all tests: a number for each figure, and little else.

    Attributes
    ----------
    tests
        Their names.
    values
        By figure that any frame has: (frames, tests), NaN where there is none.
    compared, skipped
        How many frames of each test (tests,).
    seconds
        The time of each test (tests,), including reading and writing.
    first_skipped
        The first few skipped results.
    worst
        The result with the largest maximum, if there is any.
    """

    tests: Sequence[str]
    values: dict[str, Floats] = field(default_factory=dict)
    compared: list[int] = field(default_factory=list)
    skipped: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    first_skipped: list[Result] = field(default_factory=list)
    worst: Result | None = None

    @classmethod
    def of(cls, tests: Sequence[str], frames: int, results: Iterable[Result]) -> "Overview":
        """Return the overview of results that come frame by frame, for so many frames."""
        none = [0] * len(tests)
        made = cls(tests, {}, [*none], [*none], [0.0 for _ in tests])
        row, name = -1, None
        for result in results:
            if result.frame != name:
                row, name = row + 1, result.frame
            made._take(result, row, frames)
        made.values = {name: made.values[name] for name in FIGURES if name in made.values}
        return made

    def _take(self, result: Result, row: int, frames: int) -> None:
        column = self.tests.index(result.test)
        self.seconds[column] += result.seconds[1]
        if result.skipped:
            self.skipped[column] += 1
            if len(self.first_skipped) < NAMED:
                self.first_skipped.append(result)
            return
        self.compared[column] += 1
        for name, value in result.figures.items():
            if name not in self.values:
                self.values[name] = np.full((frames, len(self.tests)), np.nan)
            self.values[name][row, column] = np.nan if value is None else value
        largest = result.figures["max_jnd"] or 0.0
        if self.worst is None or largest > (self.worst.figures["max_jnd"] or 0.0):
            self.worst = result

    def column(self, name: str, test: str) -> Floats:
        """Return the values of a figure that a test has."""
        values: Floats = self.values[name][:, self.tests.index(test)]
        return values[~np.isnan(values)]

    def exceeded(self, fail_above: float | None) -> list[int]:
        """Return on how many frames of each test the maximum is above ``fail_above``."""
        if fail_above is None or "max_jnd" not in self.values:
            return [0] * len(self.tests)
        return [int(count) for count in (self.values["max_jnd"] > fail_above).sum(0)]

    def compare(self, names: Iterable[str]) -> list[Paired]:
        """Compare every pair of tests by each of these figures that both have."""
        found = []
        for one, other in combinations(range(len(self.tests)), 2):
            for name in names:
                pairs = self.values.get(name, np.empty((0, len(self.tests))))[:, [one, other]]
                pairs = pairs[~np.isnan(pairs).any(1)]
                if len(pairs):
                    found.append(
                        statistics.compare(self.tests[one], self.tests[other], name, pairs)
                    )
        return found

    def summary(self, fail_above: float | None) -> dict[str, object]:
        """Return, for each test, how many frames were compared, and medians and extremes."""
        exceeded = self.exceeded(fail_above)
        return {
            "tests": {
                test: {
                    "compared": self.compared[number],
                    "skipped": self.skipped[number],
                    "exceeded": exceeded[number],
                    "figures": {name: _spread(self.column(name, test)) for name in self.values},
                }
                for number, test in enumerate(self.tests)
            }
        }


def _spread(values: Floats) -> dict[str, float] | None:
    if not len(values):
        return None
    return {
        "median": float(np.median(values)),
        "least": float(values.min()),
        "most": float(values.max()),
    }
