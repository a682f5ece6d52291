"""Whether a converged reference agrees when the sampler stops at its tolerance.

The *true maximum* is the largest visible difference between the image at the stop and the
converged one, by the same metric. A run keeps the promise where it is at most the tolerance. Over
all runs of a table at least 95 % must, of any scene at least 85 %, and the pooled median of true
maximum over tolerance should lie in 0.7 to 0.95: below it, samples are wasted. Beside it the
half-buffer's own stop, at one threshold for all scenes.

Synthetic scenes have a mean that is known exactly. For scenes of Mitsuba it is the mean of two
references, each rendered adaptively at a quarter of the tolerance from a seed of its own; how far
they are apart is shown, and their mean is about half as far from the truth. They are kept in
``benchmarks/cache``.

Runs are kept as they are done, in ``stopping.partial.json``: started again with the same code, an
interrupted benchmark goes on. The seeds are not those on which the sampler was developed (1 to 20).

The bias of the mean is shown as the mean over pixels and seeds of the error over its standard
error, times the root of their number: within 3 of 0 for an image without bias.
"""

import hashlib
import json
import math
import statistics
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.curves import difference
from benchmarks.places import CACHE
from benchmarks.record import blank_figure, caption, circumstances, save, source
from benchmarks.scenes import STILL_LIFE, scene_file, sized
from sampling import Sampler, Settings, rounds
from sampling.renderers import Renderer
from sampling.renderers.mitsuba import MitsubaRenderer
from sampling.renderers.synthetic import Synthetic
from torch_vdm import VDM, Display, Observer
from torch_vdm.io import atomic_path

Plane = NDArray[np.float64]
Scene = Callable[[Plane, Plane], tuple[Plane, Plane, Plane | float]]

PPD = 60.0
WHITE = 100.0

# Of the half-buffer's own stop: Cycles is set to 0.1 for previews, 0.01 for images. Status: choice.
NOISE_THRESHOLDS = (0.1, 0.03)

# A run that needs more samples a pixel has failed. Status: choice.
MAX_SPP = 2_000_000

# What must hold.
COVERAGE, SCENE_COVERAGE, MEDIAN = 0.95, 0.85, (0.7, 0.95)

# The first seed of the runs, and the seeds of references, as a share of the tolerance of the run.
FIRST_SEED = 1001
REFERENCE_SEEDS, REFERENCE_TOLERANCE = (1_000_001, 1_000_002), 0.25

REFERENCES = CACHE / "stopping"


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
    first_seed: int = FIRST_SEED


class Truth(NamedTuple):
    """What a run is judged by."""

    mean: Plane
    """(H, W, 3)."""
    apart: float
    """The largest visible difference between the two references, JND; 0 where it is exact."""


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the tables, and write stopping.json, .md and .png to ``output``."""
    torch.set_num_threads(1)
    tables = quick_tables() if quick else full_tables()
    partial = None if output is None else output / "stopping.partial.json"
    done = _resumed(partial)
    result: dict[str, Any] = {**circumstances(), "ppd": PPD, "white": WHITE, "tables": []}
    text = ""
    for table in tables:
        result["tables"].append(_measured(table, done, partial))
        text = _text(result)
        # Written after each table, for all of them take long.
        if output is not None:
            save(output, "stopping", result, text)
            _plot(result, output / "stopping.png")
    if partial is not None:
        partial.unlink(missing_ok=True)
    print(text)


def full_tables() -> list[Table]:
    """Return what the committed result is made of."""
    calibrated, paper = Observer.calibrated(), Observer.paper()
    every, cheap = tuple(SCENES), ("bright beside dark", "coloured event")
    found = tuple(name for name, (file, _) in RENDERED.items() if scene_file(file).is_file())
    return [
        Table("64x64, 2 JND", 64, 2.0, calibrated, 20, every),
        Table("Mitsuba, 64x64, 2 JND", 64, 2.0, calibrated, 20, found),
        Table("32x32, 1 JND", 32, 1.0, calibrated, 20, cheap),
        Table("32x32, 2 JND", 32, 2.0, calibrated, 5, every),
        Table("32x32, 2 JND, unbiased", 32, 2.0, calibrated, 5, every, unbiased=True),
        Table("32x32, 2 JND, uniform", 32, 2.0, calibrated, 5, every, "uniform"),
        *(
            Table(
                f"32x32, half-buffer's own stop at {threshold}, judged at 2 JND",
                *(32, 2.0, calibrated, 3, every, "halfbuffer"),
                noise_threshold=threshold,
            )
            for threshold in NOISE_THRESHOLDS
        ),
        Table("32x32, 2 JND, the paper's observer", 32, 2.0, paper, 5, every),
    ]


def quick_tables() -> list[Table]:
    """Return a smoke test's."""
    calibrated = Observer.calibrated()
    few = ("bright beside dark", "coloured event")
    return [
        Table("16x16, 3 JND", 16, 3.0, calibrated, 2, few),
        Table("16x16, 3 JND, unbiased", 16, 3.0, calibrated, 1, few, unbiased=True),
        Table(
            "16x16, half-buffer's own stop at 0.1, judged at 3 JND",
            *(16, 3.0, calibrated, 1, few, "halfbuffer"),
            noise_threshold=0.1,
        ),
        Table("Mitsuba, 16x16, 4 JND", 16, 4.0, calibrated, 1, ("still life",)),
    ]


def make_scene(name: str, side: int, seed: int) -> Synthetic:
    """Return a scene of ``side`` x ``side`` pixels."""
    y, x = np.mgrid[0:side, 0:side] / side
    base, event, chance = SCENES[name](x, y)
    return Synthetic(base, event, np.zeros((side, side)) + chance, seed)


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


def dark_rare(x: Plane, y: Plane) -> tuple[Plane, Plane, Plane | float]:
    """A black room with a dim spot, of light that one sample in a thousand finds."""
    spot = (x - 0.4) ** 2 + (y - 0.6) ** 2 < 0.0225
    return _grey(0.0 * x), _grey(np.where(spot, 0.003, 0.0)), 0.001


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
    "dark, 1 in 1000": dark_rare,
}

# Scenes of Mitsuba: the file, and parameters beside the size. Left out are those whose references
# or runs need minutes: glass, plates with lights of 1:10^4, a tiny light and its caustic, fog,
# lights out of focus.
RENDERED: dict[str, tuple[str, dict[str, str]]] = {
    "still life": (STILL_LIFE, {}),
    "Cornell box": ("cbox/scene.xml", {"max_depth": "4"}),
    "chequered plane": ("checker_horizon.xml", {}),
    "textured wall": ("textured_wall.xml", {}),
}


def _grey(value: Plane) -> Plane:
    return np.repeat(value[..., None], 3, -1)


def _renderer(name: str, side: int, seed: int) -> Renderer:
    """Return a scene with one seed's samples."""
    if name in SCENES:
        return make_scene(name, side, seed)
    file, others = RENDERED[name]
    return MitsubaRenderer(scene_file(file), {**sized(file, side), **others}, seed=seed)


def _jnd(metric: VDM, one: Plane, other: Plane) -> float:
    """Return the largest visible difference between two images, (H, W, 3)."""
    return float(difference(metric, one, other).max())


@lru_cache
def _truth(name: str, side: int, tolerance: float, observer: Observer) -> Truth:
    """Return the converged image of a scene: exact, or the mean of two references."""
    if name in SCENES:
        return Truth(make_scene(name, side, 0).mean, 0.0)
    metric = VDM(PPD, Display.linear(WHITE), observer)
    images, counts = [], []
    for seed in REFERENCE_SEEDS:
        renderer = _renderer(name, side, seed)
        assert isinstance(renderer, MitsubaRenderer)
        what = f"{renderer.fingerprint} {renderer.version} {seed} {tolerance} {observer}"
        path = REFERENCES / f"{hashlib.sha256(what.encode()).hexdigest()[:16]}.npz"
        if not path.is_file():
            settings = Settings(tolerance=REFERENCE_TOLERANCE * tolerance, max_spp=MAX_SPP)
            sampler = Sampler(renderer.size, metric, settings)
            for _ in rounds(sampler, renderer):
                pass
            REFERENCES.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                np.savez(file, image=sampler.image, count=sampler.count)
        with np.load(path) as kept:
            images.append(kept["image"])
            counts.append(kept["count"][..., None])
    mean = (images[0] * counts[0] + images[1] * counts[1]) / (counts[0] + counts[1])
    return Truth(mean, _jnd(metric, *images))


def _resumed(partial: Path | None) -> dict[str, Any]:
    """Return the runs that the same code has done before it was interrupted."""
    before: dict[str, Any] = {}
    if partial is not None and partial.is_file():
        before = json.loads(partial.read_text())
    code = source()
    return before if before.get("code") == code else {"code": code, "runs": {}}


def _measured(table: Table, done: dict[str, Any], partial: Path | None) -> dict[str, Any]:
    """Run every scene with every seed."""
    scenes: dict[str, list[dict[str, Any]]] = {}
    for name in table.scenes:
        scenes[name] = []
        for seed in range(table.first_seed, table.first_seed + table.seeds):
            key = f"{table.title}, {name}, {seed}"
            if key not in done["runs"]:
                done["runs"][key] = _once(table, name, seed)
            scenes[name].append(done["runs"][key])
        if partial is not None:
            partial.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(partial) as temporary:
                temporary.write_text(json.dumps(done))
    truths = [_truth(name, table.side, table.tolerance, table.observer) for name in table.scenes]
    return {
        "title": table.title,
        "side": table.side,
        "tolerance": table.tolerance,
        "observer": table.observer.name,
        "strategy": table.strategy,
        "unbiased": table.unbiased,
        "noise_threshold": table.noise_threshold,
        "first_seed": table.first_seed,
        "references_apart": {
            name: truth.apart for name, truth in zip(table.scenes, truths, strict=True)
        },
        "scenes": scenes,
    }


def _once(table: Table, name: str, seed: int) -> dict[str, float | str | None]:
    """Return the figures of one run."""
    metric = VDM(PPD, Display.linear(WHITE), table.observer)
    renderer = _renderer(name, table.side, seed)
    settings = Settings(
        strategy=table.strategy,
        tolerance=table.tolerance,
        max_spp=MAX_SPP,
        unbiased=table.unbiased,
        noise_threshold=table.noise_threshold,
    )
    sampler = Sampler(renderer.size, metric, settings)
    *_, report = rounds(sampler, renderer)
    truth = _truth(name, table.side, table.tolerance, table.observer)
    return {
        "true": _jnd(metric, sampler.image, truth.mean),
        "predicted": report.predicted,
        "spp": report.spp,
        "rounds": report.round,
        "stop_reason": report.stop_reason,
        "bias": _bias(sampler, renderer) if isinstance(renderer, Synthetic) else None,
    }


def _bias(sampler: Sampler, renderer: Synthetic) -> float:
    """Return the error of luminance over its true standard error, summed; its deviation is 1."""
    error = (sampler.image - renderer.mean).mean(-1)
    variance = renderer.covariance.mean((-2, -1)) / sampler.count
    noisy = variance > 0.0
    return float((error[noisy] / np.sqrt(variance[noisy])).sum() / math.sqrt(noisy.sum()))


def summary(runs: list[dict[str, Any]], tolerance: float) -> dict[str, float]:
    """Return how many runs kept the promise, and how tightly."""
    ratios = [run["true"] / tolerance for run in runs]
    biases = [run["bias"] for run in runs if run["bias"] is not None]
    return {
        "runs": len(runs),
        "kept": sum(ratio <= 1.0 for ratio in ratios),
        "median": statistics.median(ratios),
        "largest": max(ratios),
        "spp": statistics.median(run["spp"] for run in runs),
        "rounds": max(run["rounds"] for run in runs),
        "bias": sum(biases) / math.sqrt(len(biases)) if biases else math.nan,
        "given up": sum(run["stop_reason"] == "max_spp" for run in runs),
    }


def _text(result: dict[str, Any]) -> str:
    lines = ["# When the sampler stops, does a converged reference agree?", "", caption(result), ""]
    lines += [
        "| | runs that kept it | worst scene | median true / tolerance "
        "| samples a pixel, median | most rounds |",
        "|---|---|---|---|---|---|",
    ]
    for table in result["tables"]:
        found = summary(_pooled(table), table["tolerance"])
        worst = _worst(table)
        lines.append(
            f"| {table['title']} | {found['kept']} of {found['runs']} | {worst[0]}, {worst[1]:.0%} "
            f"| {found['median']:.2f} | {found['spp']:.0f} | {found['rounds']} |"
        )
    for table in result["tables"]:
        apart = table["references_apart"]
        rendered = any(apart.values())
        lines += ["", f"## {table['title']}", ""]
        lines += [
            "| scene | true <= tolerance | median true / tolerance | largest "
            "| samples a pixel | most rounds | "
            + ("references apart, JND |" if rendered else "bias, z |"),
            "|---|---|---|---|---|---|---|",
        ]
        for name, runs in (*table["scenes"].items(), ("**all**", _pooled(table))):
            found = summary(runs, table["tolerance"])
            last = f"{found['bias']:+.1f}"
            if rendered:
                last = f"{apart[name]:.2f}" if name in apart else ""
            lines.append(
                f"| {name} | {found['kept']} of {found['runs']} | {found['median']:.2f} "
                f"| {found['largest']:.2f} | {found['spp']:.0f} | {found['rounds']} | {last} |"
            )
        lines += ["", _verdict(table)]
    return "\n".join(lines) + "\n"


def _pooled(table: dict[str, Any]) -> list[dict[str, Any]]:
    return [run for runs in table["scenes"].values() for run in runs]


def _worst(table: dict[str, Any]) -> tuple[str, float]:
    """Return the scene that kept the promise in the smallest share of its runs, and the share."""
    shares = {
        name: summary(runs, table["tolerance"])["kept"] / len(runs)
        for name, runs in table["scenes"].items()
    }
    worst = min(shares, key=lambda name: shares[name])
    return ("all" if shares[worst] == 1.0 else worst), shares[worst]


def _verdict(table: dict[str, Any]) -> str:
    """Return one line that says what of the promise holds."""
    found = summary(_pooled(table), table["tolerance"])
    worst, share = _worst(table)
    kept = found["kept"] / found["runs"]
    low, high = MEDIAN
    checks = (
        (f"{kept:.1%} of runs (95 %)", kept >= COVERAGE),
        (f"worst scene {worst} {share:.0%} (85 %)", share >= SCENE_COVERAGE),
        (f"median {found['median']:.2f} (0.7 to 0.95)", low <= found["median"] <= high),
    )
    line = "; ".join(f"{what}: {'met' if met else 'not met'}" for what, met in checks) + "."
    ended = int(found["given up"])
    return line + (f" {ended} ended by {MAX_SPP} samples in a pixel." if ended else "")


def _plot(result: dict[str, Any], path: Path) -> None:
    from matplotlib import colormaps

    tables = result["tables"]
    figure = blank_figure(9.0, 0.9 + 0.9 * len(tables))
    axis = figure.subplots()
    names = [*SCENES, *RENDERED]
    colours = colormaps["tab20"](range(len(names)))
    for row, table in enumerate(tables):
        for name, runs in table["scenes"].items():
            ratios = [run["true"] / table["tolerance"] for run in runs]
            order = list(table["scenes"])
            height = row + 0.07 * (order.index(name) - 0.5 * len(order))
            colour = colours[names.index(name)]
            marker = "." if name in SCENES else "x"
            new = all(name not in earlier["scenes"] for earlier in tables[:row])
            label = name if new else None
            axis.plot(ratios, [height] * len(ratios), marker, color=colour, ms=3.0, label=label)
    axis.axvline(1.0, color="black", linewidth=0.8)
    axis.set_yticks(range(len(tables)), labels=[table["title"] for table in tables], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("true maximum / tolerance")
    axis.set_xscale("log")
    ticks = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0)
    axis.set_xticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
