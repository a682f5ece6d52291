"""What deciding costs beside rendering: the share of metric, tree and statistics in the time.

Whole runs of `vdm-render`'s loop on the Cornell box, path depth 4, by processor time of all
threads: *rendering* is the renderer's call, *statistics* folds samples in, *decisions* are all from
the variance of every pixel to the next request: variance tree, boundary images, simulation, shares.
Beside it the renderer's throughput, alone and with statistics, against Mitsuba's own `mi.render` of
as many samples, the same for every pixel: interleaved, the smallest time of each.

Without the scene (``TORCH_VDM_DATA``) the still life that comes with `vdm-render` takes its place.
"""

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.record import caption, circumstances, save
from benchmarks.scenes import STILL_LIFE, scene_file, sized
from sampling import Request, Sampler, Samples, Settings, rounds
from sampling.renderers.mitsuba import MitsubaRenderer, load_mitsuba
from sampling.statistics import Statistics
from torch_vdm import VDM, Display

SCENE, DEPTH = "cbox/scene.xml", {"max_depth": "4"}
PPD, WHITE = 60.0, 100.0

# Sides in pixels and tolerances in JND. Status: choice; the first is the one that is promised.
RUNS = ((512, 1.0), (512, 2.0), (512, 4.0), (128, 1.0))
QUICK_RUNS = ((32, 4.0),)

# Metric, tree and statistics should take no more of the time.
WANTED = 0.10

# Samples that a renderer is asked for at once, as `sampling.rounds` does.
AT_ONCE = 2**20

# Samples of every pixel for the throughput, and images, whose smallest time it is. Status: choice.
SPP, IMAGES = 64, 3


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write overhead.json and overhead.md to ``output``."""
    torch.set_num_threads(1)
    name, parameters = SCENE, DEPTH
    if not scene_file(SCENE).is_file():
        print(f"{SCENE} is not there (TORCH_VDM_DATA): the still life instead", file=sys.stderr)
        name, parameters = STILL_LIFE, {}
    result: dict[str, Any] = {**circumstances(), "scene": name, **parameters, "runs": []}
    for side, tolerance in QUICK_RUNS if quick else RUNS:
        result["runs"].append(measured(name, parameters, side, tolerance))
        print(_line(result["runs"][-1]), file=sys.stderr)
    result["throughput"] = throughput(
        name, parameters, 32 if quick else 512, 1 if quick else IMAGES
    )
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "overhead", result, table)


def measured(
    name: str, parameters: dict[str, str], side: int, tolerance: float
) -> dict[str, float | str | None]:
    """Return the seconds of a run until it stops, by what they went to."""
    renderer = MitsubaRenderer(scene_file(name), {**sized(name, side), **parameters}, seed=1)
    few = np.arange(side)
    renderer.sample(few, 0 * few, 0 * few + 1)  # compiles
    sampler = Sampler(renderer.size, VDM(PPD, Display.linear(WHITE)), Settings(tolerance=tolerance))
    seconds = dict.fromkeys(("rendering", "statistics", "decisions"), 0.0)
    clock = _Clock(renderer, seconds)
    for _ in rounds(sampler, clock, told=lambda _: clock.spent("statistics")):
        pass
    clock.spent("decisions")
    report = sampler.report()
    assert report is not None
    return {
        "side": side,
        "tolerance": tolerance,
        "rounds": report.round,
        "spp": report.spp,
        "samples": report.samples,
        "predicted": report.predicted,
        "stop_reason": report.stop_reason,
        **{f"{what}_seconds": value for what, value in seconds.items()},
        "share": 1.0 - seconds["rendering"] / sum(seconds.values()),
    }


class _Clock:
    """A renderer that says what the time has gone to."""

    def __init__(self, renderer: MitsubaRenderer, seconds: dict[str, float]) -> None:
        self.size = renderer.size
        self._renderer, self._seconds = renderer, seconds
        self._before = time.process_time()

    def spent(self, what: str) -> None:
        now = time.process_time()
        self._seconds[what] += now - self._before
        self._before = now

    def sample(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> Samples:
        self.spent("decisions")
        samples = self._renderer.sample(pixels, first, count)
        self.spent("rendering")
        return samples


def throughput(
    name: str, parameters: dict[str, str], side: int, images: int
) -> dict[str, float | int]:
    """Return million samples a second of processor time of three ways to draw as many."""
    parameters = {**sized(name, side), **parameters}
    renderer = MitsubaRenderer(scene_file(name), parameters, seed=1)
    mi = load_mitsuba(renderer.variant)
    scene = mi.load_file(str(scene_file(name)), **parameters)
    pixels = np.arange(side * side)
    count = np.full(len(pixels), SPP)
    statistics = Statistics(len(pixels))

    def own(number: int) -> None:
        np.array(mi.render(scene, spp=SPP, seed=number))

    def ours(number: int, kept: Statistics | None = None) -> None:
        for part in Request(pixels, number * count, count).parts(AT_ONCE):
            samples = renderer.sample(part.pixels, part.first, part.count)
            if kept is not None:
                kept.add(samples)

    ways: dict[str, Callable[[int], None]] = {
        "mi.render": own,
        "samples": ours,
        "samples and statistics": lambda number: ours(number, statistics),
    }
    best = dict.fromkeys(ways, math.inf)
    for number in range(images + 1):
        for way, draw in ways.items():
            start = time.process_time()
            draw(number)
            # The first call compiles.
            best[way] = min(best[way], time.process_time() - start if number else math.inf)
    return {
        "side": side,
        "spp": SPP,
        **{way: 1e-6 * len(pixels) * SPP / seconds for way, seconds in best.items()},
    }


def _line(row: dict[str, Any]) -> str:
    share = f"**{row['share']:.1%}**" if row["share"] <= WANTED else f"{row['share']:.1%}"
    return (
        f"| {row['side']}x{row['side']} | {row['tolerance']:g} | {row['rounds']} "
        f"| {row['spp']:.0f} | {row['rendering_seconds']:.1f} | {row['statistics_seconds']:.1f} "
        f"| {row['decisions_seconds']:.1f} | {share} |"
    )


def _table(result: dict[str, Any]) -> str:
    speed = result["throughput"]
    depth = f", path depth {result['max_depth']}" if "max_depth" in result else ""
    lines = [
        "# What deciding costs beside rendering",
        "",
        caption(result),
        "",
        f"{result['scene']}{depth}, one run each until it stops by itself; seconds of processor "
        f"time. At most {WANTED:.0%} for statistics and decisions is wanted; shares that keep to "
        "it are bold.",
        "",
        "| size | tolerance, JND | rounds | samples a pixel | rendering, s | statistics, s "
        "| decisions, s | share of statistics and decisions |",
        "|---|---|---|---|---|---|---|---|",
        *map(_line, result["runs"]),
        "",
        f"Throughput at {speed['side']}x{speed['side']}, {speed['spp']} samples of every pixel, "
        "processor time:",
        "",
        "| | samples/s, million | time against mi.render |",
        "|---|---|---|",
        *(
            f"| {way} | {speed[way]:.2f} | {speed['mi.render'] / speed[way]:.2f} |"
            for way in ("mi.render", "samples", "samples and statistics")
        ),
    ]
    return "\n".join(lines) + "\n"
