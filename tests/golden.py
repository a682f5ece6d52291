"""Thresholds that the committed observer has: ``python -m tests.golden`` writes them anew.

A change of them is a change of what people are said to see: the fit was made again, or a stage
computes otherwise.
"""

import csv
from pathlib import Path

import torch

from benchmarks.thresholds import Threshold, pattern, render, sampling
from torch_vdm import VDM, Display
from torch_vdm.cli import TRANSFORMS

TABLE = Path(__file__).parent / "golden_thresholds.csv"

# Directions S, M, L; a stimulus has that contrast times its threshold.
GREY, RED_GREEN, YELLOW_VIOLET = (1.0, 1.0, 1.0), (0.0, -1.0, 0.5), (1.0, 0.0, 0.0)

# Half of the bisection's range and its centre, dB, and its steps: to 0.01 dB.
RANGE, CENTRE, STEPS = 40.0, -30.0, 13


def stimulus(
    frequency: float,
    area: float,
    luminance: float,
    direction: tuple[float, float, float] = GREY,
    kind: str = "gabor",
    orientation: float = 0.0,
) -> Threshold:
    """Return a stimulus as a row of the table; a Gabor patch has half its side as sigma."""
    sigma = 0.5 * area**0.5 if kind == "gabor" else None
    return Threshold(0, "", "", "", frequency, area, sigma, luminance, direction, kind, orientation)


STIMULI = {
    "gabor, 0.5 cpd, 100 cd/m2": stimulus(0.5, 1.0, 100.0),
    "gabor, 4 cpd, 100 cd/m2": stimulus(4.0, 0.1, 100.0),
    "gabor, 4 cpd, 100 cd/m2, large": stimulus(4.0, 1.0, 100.0),
    "gabor, 12 cpd, 100 cd/m2, horizontal": stimulus(12.0, 0.05, 100.0, orientation=90.0),
    "grating, 2 cpd, 100 cd/m2": stimulus(2.0, 4.0, 100.0, kind="grating"),
    "gabor, 1 cpd, 0.01 cd/m2": stimulus(1.0, 1.0, 0.01),
    "gabor, 2 cpd, 1 cd/m2": stimulus(2.0, 0.5, 1.0),
    "gabor, 2 cpd, 5000 cd/m2": stimulus(2.0, 0.5, 5000.0),
    "disc, 0.5 degrees, 100 cd/m2": stimulus(0.0, 0.2, 100.0, kind="disk"),
    "red-green gabor, 0.5 cpd, 20 cd/m2": stimulus(0.5, 1.0, 20.0, RED_GREEN),
    "red-green gabor, 4 cpd, 20 cd/m2": stimulus(4.0, 0.2, 20.0, RED_GREEN),
    "yellow-violet gabor, 0.5 cpd, 20 cd/m2": stimulus(0.5, 1.0, 20.0, YELLOW_VIOLET),
    "yellow-violet gabor, 2 cpd, 100 cd/m2": stimulus(2.0, 1.0, 100.0, YELLOW_VIOLET),
}


def threshold(of: Threshold, accuracy: str) -> float:
    """Return the contrast at which `VDM.score` is 1, in dB re 1, by bisection."""
    ppd = sampling(of, 8.0)
    drawn = pattern(of, ppd, 0.4)
    metric = VDM(ppd, Display.xyz(), transform=TRANSFORMS[accuracy]())
    flat = render(of, drawn, 0.0)
    low, high = CENTRE - RANGE, CENTRE + RANGE
    for _ in range(STEPS):
        middle = 0.5 * (low + high)
        seen = float(metric.score(render(of, drawn, 10.0 ** (middle / 20.0)), flat)) > 1.0
        low, high = (low, middle) if seen else (middle, high)
    return 0.5 * (low + high)


# All stimuli for the paper's transform, and a few for the slower ones.
CASES = [
    (name, accuracy)
    for accuracy in TRANSFORMS
    for name in list(STIMULI)[:: 1 if accuracy == "fast" else 5]
]


def read() -> dict[tuple[str, str], float]:
    """Return the committed thresholds in dB re 1, by stimulus and accuracy."""
    with TABLE.open(newline="") as file:
        return {
            (row["stimulus"], row["accuracy"]): float(row["threshold_db"])
            for row in csv.DictReader(file)
        }


def main() -> None:
    """Write the table."""
    with torch.no_grad():
        found = {case: threshold(STIMULI[case[0]], case[1]) for case in CASES}
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("stimulus", "accuracy", "threshold_db"))
        writer.writerows((*case, f"{value:.2f}") for case, value in found.items())


if __name__ == "__main__":
    main()
