"""What skipping untouched tiles saves, and from where on it no longer pays.

The local errors of an image (`sampling.tiles`) where some pixels have other numbers of samples:
with untouched tiles skipped, whatever it costs, and with all computed, interleaved, processor time
of one thread, medians. Touched are a square of pixels, or pixels scattered at random. That both
give the same bits is checked in every row.
"""

import statistics
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.record import blank_figure, caption, circumstances, save
from benchmarks.stopping import make_scene
from sampling.prediction import Model
from sampling.statistics import Statistics
from sampling.tiles import PAYS
from torch_vdm import VDM, Display

SIDE, QUICK_SIDE = 512, 256

# Samples of every pixel, and by what those of touched pixels grow. Status: choice.
SPP, GROWTH = 16, 2.0

# Shares of the pixels that are touched. Status: choice.
CLUSTERED = (0.0, 1e-4, 1e-3, 0.01, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
SCATTERED = (1e-5, 3e-5, 1e-4, 2e-4, 3e-4, 5e-4, 7e-4, 1e-3, 2e-3, 5e-3, 1e-2, 0.1)

# Timings of a row; with --quick one. Status: choice.
REPEATS = 21

ALL, ALWAYS = -1.0, 1.0


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write tiles.json, tiles.md and tiles.png to ``output``."""
    torch.set_num_threads(1)
    side = QUICK_SIDE if quick else SIDE
    renderer = make_scene("texture", side, 1)
    pixels = np.arange(side * side)
    seen = Statistics(len(pixels))
    seen.add(renderer.sample(pixels, 0 * pixels, 0 * pixels + SPP))
    model = Model(VDM(60.0, Display.linear(100.0)), seen, renderer.size)
    rows = []
    with torch.no_grad():
        for kind, touched in _touches(side):
            leaves = model.leaves(model.count * np.where(touched, GROWTH, 1.0))
            rows.append(
                {
                    "kind": kind,
                    "pixels": float(touched.mean()),
                    "tiles": model.errors.touched(leaves),
                    **_measured(model, leaves, 1 if quick else REPEATS),
                }
            )
    result: dict[str, Any] = {
        **circumstances(),
        "side": side,
        "pays": PAYS,
        "crossing": {kind: _crossing(rows, kind) for kind in ("clustered", "scattered")},
        "rows": rows,
    }
    table = _table(result)
    print(table)
    if not all(row["same"] for row in rows):
        raise AssertionError("expected the same bits with tiles skipped, got others")
    if output is not None:
        save(output, "tiles", result, table)
        _plot(result, output / "tiles.png")


def _touches(side: int) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield kinds, and which pixels are touched."""
    rng = np.random.default_rng(1)
    for share in CLUSTERED:
        touched = np.zeros((side, side), np.bool_)
        edge = round(side * share**0.5)
        top, left = rng.integers(0, side - edge + 1, 2)
        touched[top : top + edge, left : left + edge] = True
        yield "clustered", touched
    for share in SCATTERED:
        yield "scattered", rng.random((side, side)) < share


def _measured(model: Model, leaves: torch.Tensor, repeats: int) -> dict[str, float | bool]:
    """Return seconds with tiles skipped, with all computed, and as the sampler chooses."""
    ways = {"skipping": ALWAYS, "all": ALL, "chosen": PAYS}
    found = {way: model.errors.at(leaves, pays) for way, pays in ways.items()}
    seconds: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(repeats):
        for way, pays in ways.items():
            start = time.process_time()
            model.errors.at(leaves, pays)
            seconds[way].append(time.process_time() - start)
    same = all(
        torch.equal(one, other)
        for way in ways
        for one, other in zip(found[way], found["all"], strict=True)
    )
    return {**{way: statistics.median(times) for way, times in seconds.items()}, "same": same}


def _crossing(rows: list[dict[str, Any]], kind: str) -> float | None:
    """Return the share of tiles from which on skipping costs more than computing all."""
    points: list[tuple[float, float]] = [
        (row["tiles"], row["skipping"] / row["all"]) for row in rows if row["kind"] == kind
    ]
    points.sort()
    for (share, cost), (next_share, next_cost) in pairwise(points):
        if cost <= 1.0 < next_cost:
            crossing: float = share + (1.0 - cost) / (next_cost - cost) * (next_share - share)
            return crossing
    return None


def _table(result: dict[str, Any]) -> str:
    found = [
        f"{kind} {share:.2f}" for kind, share in result["crossing"].items() if share is not None
    ]
    lines = [
        "# Untouched tiles",
        "",
        caption(result),
        "",
        f"Local errors of a {result['side']}x{result['side']} image where some pixels have other "
        "numbers of samples; cost relative to computing all. Skipping pays up to a share of "
        f"touched tiles of: {', '.join(found) or 'not reached'}; the sampler skips up to "
        f"{result['pays']:g} of a level. Same bits in every row.",
        "",
        "| touched | pixels | tiles | all, ms | skipping | as chosen |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['kind']} | {row['pixels']:.3%} | {row['tiles']:.1%} | {1e3 * row['all']:.1f} "
        f"| {row['skipping'] / row['all']:.2f} | {row['chosen'] / row['all']:.2f} |"
        for row in result["rows"]
    ]
    return "\n".join(lines) + "\n"


def _plot(result: dict[str, Any], path: Path) -> None:
    figure = blank_figure(8.0, 3.6)
    by_tiles, by_pixels = figure.subplots(1, 2, sharey=True)
    for kind, colour in (("clustered", "#3b5b92"), ("scattered", "#c8553d")):
        for axis, what in ((by_tiles, "tiles"), (by_pixels, "pixels")):
            # Of none there is no logarithm.
            rows = [row for row in result["rows"] if row["kind"] == kind]
            rows = [row for row in rows if axis is by_tiles or row["pixels"] > 0.0]
            rows.sort(key=lambda row: row[what])
            shares = [100.0 * row[what] for row in rows]
            skipping = [row["skipping"] / row["all"] for row in rows]
            chosen = [row["chosen"] / row["all"] for row in rows]
            axis.plot(shares, skipping, "o-", ms=3.0, color=colour, label=f"{kind}, skipping")
            axis.plot(shares, chosen, "--", color=colour, label=f"{kind}, as chosen")
        crossing = result["crossing"][kind]
        if crossing is not None:
            by_tiles.plot(100.0 * crossing, 1.0, "x", ms=9.0, mew=2.0, color=colour)
            above = kind == "clustered"
            by_tiles.annotate(
                f"{100.0 * crossing:.0f} %",
                (100.0 * crossing, 1.0),
                xytext=(-28, 6) if above else (8, -14),
                textcoords="offset points",
                color=colour,
                fontsize=9,
            )
    for axis in (by_tiles, by_pixels):
        axis.axhline(1.0, color="black", linewidth=0.8)
        axis.spines[["top", "right"]].set_visible(False)
    threshold = 100.0 * result["pays"]
    by_tiles.axvline(threshold, color="grey", linewidth=0.8, linestyle=":")
    by_tiles.text(threshold - 1.0, 0.05, "skipped up to here", ha="right", color="grey", fontsize=8)
    by_tiles.set_xlabel("touched tiles, %")
    by_tiles.set_ylabel("cost, all computed = 1")
    by_tiles.set_ylim(bottom=0.0)
    by_pixels.set_xlabel("touched pixels, %")
    by_pixels.set_xscale("log")
    ticks = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0)
    by_pixels.set_xticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    by_pixels.minorticks_off()
    by_pixels.legend(frameon=False, fontsize=8, loc="lower right")
    figure.savefig(path)
