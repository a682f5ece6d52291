"""The fewest samples that placement could need on the real scenes of `benchmarks.paper`.

No sampler knows the converged image and the noise of its pixels; here both are taken as known, from
many samples of every pixel. How many samples are needed, evenly spread, until simulated images, of
this noise, differ from the converged one by the tolerance at most, in the mean? And how many where
each pixel has the share that a descent along the gradient of these maxima finds? What lies between
is all that any placement can save; what `benchmarks.paper` finds of it stands beside it.
"""

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.curves import Scene, metric_of
from benchmarks.paper import REAL_SIDE, real_scenes, share
from benchmarks.record import caption, circumstances, save
from sampling import Request
from sampling.renderers.mitsuba import MitsubaRenderer
from sampling.statistics import FIRST, SECOND, Statistics
from torch_vdm import VDM

# Of no other run.
SEED = 2_000_000

# Samples of every pixel that are taken for the truth. Status: choice.
SPP, QUICK_SPP = 2048, 32

# Steps of a descent, after each of which a number of samples is found anew. Status: choice, after
# which no scene gains more than 3 %.
STEPS, QUICK_STEPS, DESCENTS = 100, 3, 4

# Simulated images of a step, and of a maximum that is known to 1 or 2 %. Status: choice.
BATCH, DRAWS = 4, 24

# Of the logarithm of a pixel's share: the first step, and the last. Status: choice.
FIRST_STEP, LAST_STEP = 0.06, 0.004

# Power that stands for a maximum where a derivative is needed, of the map. Status: choice.
SHARPNESS = 24.0

# Halvings of the logarithm of a number of samples, between 1 and a million: to 1 %.
HALVINGS = 11


class Oracle:
    """A scene whose image and noise are known, seen with any number of samples.

    Parameters
    ----------
    metric
        Who judges.
    statistics
        Of many samples of every pixel.
    size
        Height and width.
    """

    def __init__(self, metric: VDM, statistics: Statistics, size: tuple[int, int]) -> None:
        self.metric = metric
        self.image = torch.from_numpy(statistics.mean.reshape(1, 3, *size)).float()
        matrices = np.zeros((3, 3, statistics.mean.shape[1]))
        matrices[FIRST, SECOND] = matrices[SECOND, FIRST] = statistics.covariance()
        powers, axes = np.linalg.eigh(np.moveaxis(matrices, -1, 0))
        roots = axes * np.sqrt(np.maximum(powers, 0.0))[:, None]
        # From normal numbers to R, G, B: of a single sample.
        self.root = torch.from_numpy(np.moveaxis(roots, 0, -1).reshape(3, 3, *size)).float()

    def seen(self, samples: Tensor, images: int, generator: torch.Generator) -> Tensor:
        """Return the maps of simulated images with ``samples`` (H, W), to their own power."""
        normal = torch.randn(images, 3, *samples.shape, generator=generator)
        noise = (self.root * normal[:, None]).sum(2) / samples.sqrt()
        converged = self.image.expand(images, -1, -1, -1)
        return self.metric.power(converged + noise, converged)

    @torch.no_grad()
    def needed(self, shape: Tensor, tolerance: float) -> float:
        """Return the samples a pixel, shared as ``shape`` (H, W) says, for a mean maximum."""
        low, high = 0.0, math.log(1e6)
        exponent = float(self.metric.observer.summation_exponent)
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            generator = torch.Generator().manual_seed(SEED)
            seen = self.seen(math.exp(middle) * shape / shape.mean(), DRAWS, generator)
            largest = float((seen.amax((1, 2, 3)) ** (1.0 / exponent)).mean())
            low, high = (middle, high) if largest > tolerance else (low, middle)
        return math.exp(high)

    def least(self, tolerance: float, spp: float, steps: int) -> float:
        """Return what is needed where samples lie best; ``spp`` where they lie evenly."""
        logarithm = torch.zeros(self.image.shape[-2:], requires_grad=True)
        optimiser = torch.optim.Adam([logarithm], FIRST_STEP)
        generator = torch.Generator().manual_seed(SEED + 1)
        found = [spp]
        falling = (LAST_STEP / FIRST_STEP) ** (1.0 / (steps * DESCENTS))
        power = SHARPNESS / float(self.metric.observer.summation_exponent)
        for _ in range(DESCENTS):
            for _ in range(steps):
                shape = torch.exp(logarithm)
                seen = self.seen(found[-1] * shape / shape.mean(), BATCH, generator)
                loss = torch.logsumexp(power * seen.clamp_min(1e-30).log().flatten(1), 1).mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
                optimiser.param_groups[0]["lr"] *= falling
            found.append(self.needed(torch.exp(logarithm.detach()), tolerance))
        return min(found)


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write oracle.json and oracle.md to ``output``."""
    torch.set_num_threads(1)
    result: dict[str, Any] = {**circumstances(), "spp": QUICK_SPP if quick else SPP, "rows": []}
    scenes = real_scenes(16 if quick else REAL_SIDE)
    for row in rows(scenes[:1] if quick else scenes, result["spp"], quick):
        result["rows"].append(row)
        print(row, file=sys.stderr)
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "oracle", result, table)


def rows(scenes: list[Scene], spp: int, quick: bool) -> Iterator[dict[str, Any]]:
    """Yield what each scene needs for each of its tolerances, evenly and at the least."""
    paper = Path(__file__).parent / "results" / "paper.json"
    measured = json.loads(paper.read_text())["scenes"] if paper.exists() and not quick else {}
    for scene in scenes:
        renderer = MitsubaRenderer(scene.path, scene.parameters, seed=SEED)
        pixels = np.arange(math.prod(renderer.size))
        statistics = Statistics(len(pixels))
        for part in Request(pixels, 0 * pixels, 0 * pixels + spp).parts(2**20):
            statistics.add(renderer.sample(part.pixels, part.first, part.count))
        oracle = Oracle(metric_of(scene), statistics, renderer.size)
        for place, tolerance in enumerate(scene.tolerances):
            even = oracle.needed(torch.ones(renderer.size), tolerance)
            least = oracle.least(tolerance, even, QUICK_STEPS if quick else STEPS)
            yield {
                "scene": scene.name,
                "tolerance": tolerance,
                "even": even,
                "least": least,
                "share": least / even,
                "found": share(measured[scene.name], "uniform", "spp", place)
                if scene.name in measured
                else None,
            }


def _table(result: dict[str, Any]) -> str:
    lines = [
        "# What placement could save",
        "",
        caption(result),
        "",
        "Samples a pixel until the largest visible difference of simulated images is the tolerance",
        f"in the mean, image and noise known from {result['spp']} samples of every pixel; and what",
        "`python -m benchmarks paper` finds of perceptual beside uniform, who know neither.",
        "",
        "| scene | JND | evenly | at the least | share | found |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["rows"]:
        found = "" if row["found"] is None else f"{row['found']:.2f}"
        lines.append(
            f"| {row['scene']} | {row['tolerance']:g} | {row['even']:.0f} | {row['least']:.0f} "
            f"| {row['share']:.2f} | {found} |"
        )
    for tolerance in sorted({row["tolerance"] for row in result["rows"]})[::-1]:
        some = [row for row in result["rows"] if row["tolerance"] == tolerance]
        means = [
            f"{geometric_mean(row[name] for row in some):.2f}"
            if all(row[name] is not None for row in some)
            else ""
            for name in ("share", "found")
        ]
        lines.append(f"| geometric mean | {tolerance:g} | | | {means[0]} | {means[1]} |")
    return "\n".join(lines) + "\n"
