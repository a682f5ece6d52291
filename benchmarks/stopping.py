"""Whether a converged reference agrees when the sampler stops at its tolerance.

Synthetic scenes, whose mean is known exactly: the *true maximum* is the largest visible difference
between the image at the stop and that mean, by the same metric. A run keeps the promise where it
is at most the tolerance. Over all runs of a table at least 95 % must, of any scene at least 85 %,
and the pooled median of true maximum over tolerance should lie in 0.7 to 0.95: below it, samples
are wasted. Beside it the half-buffer's own stop, at one threshold for all scenes.

The bias of the mean is shown as the mean over pixels and seeds of the error over its standard
error, times the root of their number: within 3 of 0 for an image without bias.
"""

import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.record import caption, circumstances, save
from sampling import Sampler, Settings, rounds
from sampling.renderers.synthetic import Synthetic
from torch_vdm import VDM, Display, Observer

Plane = NDArray[np.float64]
Scene = Callable[[Plane, Plane], tuple[Plane, Plane, float]]

PPD = 60.0
WHITE = 100.0

# Of the half-buffer's own stop. Status: choice.
NOISE_THRESHOLD = 0.02

# A run that needs more samples a pixel has failed. Status: choice.
MAX_SPP = 2_000_000

# What must hold.
COVERAGE, SCENE_COVERAGE, MEDIAN = 0.95, 0.85, (0.7, 0.95)


class Table(NamedTuple):
    """A set of runs that are pooled."""

    title: str
    side: int
    tolerance: float
    observer: Observer
    seeds: int
    scenes: tuple[str, ...]
    strategy: Any = "perceptual"
    unbiased: bool = False
    noise_threshold: float | None = None


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the tables, and write stopping.json, .md and .png to ``output``."""
    torch.set_num_threads(1)
    tables = quick_tables() if quick else full_tables()
    result: dict[str, Any] = {**circumstances(), "ppd": PPD, "white": WHITE, "tables": []}
    # Written after each table, for all of them take long.
    for table in tables:
        result["tables"].append(_measured(table))
        text = _text(result)
        if output is not None:
            save(output, "stopping", result, text)
            _plot(result, output / "stopping.png")
    print(text)


def full_tables() -> list[Table]:
    """Return what the committed result is made of."""
    calibrated, paper = Observer.calibrated(), Observer.paper()
    every, cheap = tuple(SCENES), ("bright beside dark", "coloured event")
    return [
        Table("64x64, 2 JND", 64, 2.0, calibrated, 20, every),
        Table("32x32, 1 JND", 32, 1.0, calibrated, 20, cheap),
        Table("32x32, 2 JND, unbiased", 32, 2.0, calibrated, 10, every, unbiased=True),
        Table("32x32, 2 JND", 32, 2.0, calibrated, 20, every),
        Table("32x32, 2 JND, uniform", 32, 2.0, calibrated, 10, every, "uniform"),
        Table("32x32, 2 JND, the paper's observer", 32, 2.0, paper, 10, every),
        Table(
            f"32x32, half-buffer's own stop at {NOISE_THRESHOLD}, beside 2 JND",
            *(32, 2.0, calibrated, 10, every, "halfbuffer"),
            noise_threshold=NOISE_THRESHOLD,
        ),
    ]


def quick_tables() -> list[Table]:
    """Return a smoke test's."""
    calibrated = Observer.calibrated()
    few = ("bright beside dark", "coloured event")
    return [
        Table("16x16, 3 JND", 16, 3.0, calibrated, 2, few),
        Table("16x16, 3 JND, unbiased", 16, 3.0, calibrated, 1, few, unbiased=True),
        Table(
            "16x16, half-buffer's own stop at 0.1, beside 3 JND",
            *(16, 3.0, calibrated, 1, few, "halfbuffer"),
            noise_threshold=0.1,
        ),
    ]


def make_scene(name: str, side: int, seed: int) -> Synthetic:
    """Return a scene of ``side`` x ``side`` pixels."""
    y, x = np.mgrid[0:side, 0:side] / side
    base, event, chance = SCENES[name](x, y)
    return Synthetic(base, event, np.full((side, side), chance), seed)


def flat(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """Only noise, with a standard deviation as large as the mean."""
    grey = _grey(0.2 + 0.0 * (x + y))
    return 0.0 * grey, grey, 0.5


def gradient(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """From 0.5 to 50 cd/m2, so that noise grows with light."""
    grey = _grey(0.005 * 100.0**x + 0.0 * y)
    return 0.0 * grey, grey, 0.5


def texture(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """Plain on the left, a random texture on the right."""
    rough = np.random.default_rng(7).uniform(0.2, 1.0, x.shape)
    grey = _grey(np.where(x < 0.5, 0.5, rough) + 0.0 * y)
    return 0.3 * grey, 0.3 * grey, 0.3


def bright_beside_dark(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """A disc of 80 cd/m2 on 1 cd/m2."""
    inside = (x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.09
    grey = _grey(np.where(inside, 0.8, 0.01))
    return 0.5 * grey, 0.5 * grey, 0.3


def chromatic(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """Red and green stripes, blue ones across them."""
    across, down = 0.2 * np.sin(8.0 * np.pi * x), 0.2 * np.sin(8.0 * np.pi * y)
    colour = np.stack((0.3 + across, 0.3 - across, 0.3 + down), -1)
    return 0.6 * colour, 0.4 * colour, 0.3


def coloured_event(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """Violet noise on grey."""
    colour = np.stack((0.05 + 0.0 * x, 0.02 + 0.0 * y, 0.12 + 0.0 * x), -1)
    return 0.0 * colour + 0.3, colour, 0.2


def rare_hundred(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """A light that one sample in a hundred finds, on a lit wall."""
    return _grey(0.3 + 0.0 * y), _grey(0.03 * (0.5 + x)), 0.01


def rare_thousand(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """A light that one sample in a thousand finds, on the lower part of a lit wall."""
    return _grey(0.3 + 0.0 * x), _grey(np.where(y > 0.3, 0.012, 0.0)), 0.001


def caustic(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """A spot of rare light."""
    spot = np.exp(-((x - 0.4) ** 2 + (y - 0.6) ** 2) / 0.01)
    return _grey(0.2 + 0.0 * x), _grey(0.15 * spot), 0.003


def half_black(x: Plane, y: Plane) -> tuple[Plane, Plane, float]:
    """A wall, and a black one with only a faint light that is often missed."""
    grey = _grey(np.where(x > 0.5, 0.0, 0.4) + 0.0 * y)
    return 0.5 * grey, 0.5 * grey + 0.002, 0.3


SCENES: dict[str, Scene] = {
    "flat": flat,
    "gradient": gradient,
    "texture": texture,
    "bright beside dark": bright_beside_dark,
    "chromatic": chromatic,
    "coloured event": coloured_event,
    "rare, 1 in 100": rare_hundred,
    "rare, 1 in 1000": rare_thousand,
    "caustic": caustic,
    "half black": half_black,
}


def _grey(value: Plane) -> Plane:
    return np.repeat(value[..., None], 3, -1)


def _measured(table: Table) -> dict[str, Any]:
    """Run every scene with every seed."""
    return {
        "title": table.title,
        "side": table.side,
        "tolerance": table.tolerance,
        "observer": table.observer.name,
        "strategy": table.strategy,
        "unbiased": table.unbiased,
        "noise_threshold": table.noise_threshold,
        "scenes": {
            name: [_once(table, name, seed) for seed in range(table.seeds)] for name in table.scenes
        },
    }


def _once(table: Table, name: str, seed: int) -> dict[str, float | str | None]:
    """Return the figures of one run."""
    metric = VDM(PPD, Display.linear(WHITE), table.observer)
    renderer = make_scene(name, table.side, seed)
    settings = Settings(
        strategy=table.strategy,
        tolerance=table.tolerance,
        max_spp=MAX_SPP,
        unbiased=table.unbiased,
        noise_threshold=table.noise_threshold,
    )
    sampler = Sampler(renderer.size, metric, settings)
    *_, report = rounds(sampler, renderer)
    image, truth = (
        torch.from_numpy(np.moveaxis(plane, -1, 0)[None].copy())
        for plane in (sampler.image, renderer.mean)
    )
    with torch.no_grad():
        true = float(metric(image, truth).max())
    # Of luminance, by the true variance.
    error = (sampler.image - renderer.mean).mean(-1)
    variance = renderer.covariance.mean((-2, -1)) / sampler.count
    noisy = variance > 0.0
    return {
        "true": true,
        "predicted": report.predicted,
        "spp": report.spp,
        "rounds": report.round,
        "stop_reason": report.stop_reason,
        "bias": float((error[noisy] / np.sqrt(variance[noisy])).sum() / math.sqrt(noisy.sum())),
    }


def summary(runs: list[dict[str, Any]], tolerance: float) -> dict[str, float]:
    """Return how many runs kept the promise, and how tightly."""
    ratios = [run["true"] / tolerance for run in runs]
    return {
        "runs": len(runs),
        "kept": sum(ratio <= 1.0 for ratio in ratios),
        "median": statistics.median(ratios),
        "largest": max(ratios),
        "spp": statistics.median(run["spp"] for run in runs),
        "rounds": max(run["rounds"] for run in runs),
        "bias": sum(run["bias"] for run in runs) / math.sqrt(len(runs)),
    }


def _text(result: dict[str, Any]) -> str:
    lines = ["# When the sampler stops, does a converged reference agree?", "", caption(result)]
    for table in result["tables"]:
        pooled = [run for runs in table["scenes"].values() for run in runs]
        lines += ["", f"## {table['title']}", ""]
        lines += [
            "| scene | true <= tolerance | median true / tolerance | largest "
            "| samples a pixel | most rounds | bias, z |",
            "|---|---|---|---|---|---|---|",
        ]
        for name, runs in (*table["scenes"].items(), ("**all**", pooled)):
            found = summary(runs, table["tolerance"])
            lines.append(
                f"| {name} | {found['kept']} of {found['runs']} | {found['median']:.2f} "
                f"| {found['largest']:.2f} | {found['spp']:.0f} | {found['rounds']} "
                f"| {found['bias']:+.1f} |"
            )
        lines += ["", _verdict(table, pooled)]
    return "\n".join(lines) + "\n"


def _verdict(table: dict[str, Any], pooled: list[dict[str, Any]]) -> str:
    """Return one line that says what of the promise holds."""
    found = summary(pooled, table["tolerance"])
    shares = {
        name: summary(runs, table["tolerance"])["kept"] / len(runs)
        for name, runs in table["scenes"].items()
    }
    worst = min(shares, key=lambda name: shares[name])
    kept = found["kept"] / found["runs"]
    low, high = MEDIAN
    checks = (
        (f"{kept:.1%} of runs (95 %)", kept >= COVERAGE),
        (f"worst scene {worst} {shares[worst]:.0%} (85 %)", shares[worst] >= SCENE_COVERAGE),
        (f"median {found['median']:.2f} (0.7 to 0.95)", low <= found["median"] <= high),
    )
    return "; ".join(f"{what}: {'met' if met else 'not met'}" for what, met in checks) + "."


def _plot(result: dict[str, Any], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    tables = result["tables"]
    figure = Figure(figsize=(9.0, 0.9 + 0.9 * len(tables)), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    names = list(SCENES)
    for row, table in enumerate(tables):
        for name, runs in table["scenes"].items():
            ratios = [run["true"] / table["tolerance"] for run in runs]
            height = row + 0.07 * (names.index(name) - 0.5 * len(names))
            colour = f"C{names.index(name)}"
            label = name if row == 0 else None
            axis.plot(ratios, [height] * len(ratios), ".", color=colour, ms=3.0, label=label)
    axis.axvline(1.0, color="black", linewidth=0.8)
    axis.set_yticks(range(len(tables)), labels=[table["title"] for table in tables], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("true maximum / tolerance")
    axis.set_xlim(left=0.0)
    axis.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
