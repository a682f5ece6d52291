"""What each effect of light costs to render, what leaving it out would show, and what auto saves.

For each scene: the time of a sample without media, and with paths of no more than D segments, over
that of what the scene asks for, and the largest visible difference that it makes to the converged
picture. The two pictures are of the same random numbers, so that they differ by what is left out
alone. Then whole runs of `sampling.render`, with ``effects="full"`` and ``"auto"``.

Times are processor times, of all threads, the medians of interleaved rounds: other programs that
run beside lengthen both alike.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks import record
from benchmarks.curves import difference
from benchmarks.places import ROOT
from benchmarks.scenes import STILL_LIFE, scene_file, sized
from sampling import Samples, render
from sampling.plan import CUTS, SHARE
from sampling.renderers.mitsuba import MitsubaRenderer
from torch_vdm import VDM, Display

THREADS = 1
PPD, WHITE, TOLERANCE = 60.0, 100.0, 1.0

# Scenes of our own, what they are, and those that ask for more than they need.
OWN = {
    "dim_room": "a dim room, 16 segments, no roulette",
    "open": "things in the open, volpath, 32 segments",
    "plane": "a plane without end",
    "dark_corner": "a room with a dark corner",
    "mirrors": "mirrors behind mirrors",
    "glass": "panes of glass",
    "caustic": "a caustic",
    "fog": "fog",
}
ASK_TOO_MUCH = ("plane", "open", "dim_room")

# Sides of pictures whose difference is looked at and of whole runs, samples, rounds; with --quick.
FULL = {"side": 96, "run": 512, "count": 96, "rounds": 5, "runs": 4, "most": 32}
QUICK = {"side": 16, "run": 24, "count": 16, "rounds": 1, "runs": 1, "most": 16}

# What is wanted: times as fast, times as slow, and the share of the tolerance that is missing.
FASTER, SLOWER = 1.5, 1.03

# A scene's parameters, by the side of its picture.
Parameters = Callable[[int], dict[str, str]]


def scenes(quick: bool) -> dict[str, tuple[Path, Parameters]]:
    """Return the scenes by name: their files, and parameters by the side."""
    folder = ROOT / "benchmarks" / "scenes"

    def square(side: int) -> dict[str, str]:
        return {"width": str(side), "height": str(side)}

    names = ("open", "caustic") if quick else tuple(OWN)
    found: dict[str, tuple[Path, Parameters]] = {
        name: (folder / f"{name}.xml", square) for name in names
    }
    box = scene_file("cbox/scene.xml")
    if not quick:
        found["still life"] = scene_file(STILL_LIFE), partial(sized, STILL_LIFE)
        if box.is_file():
            found["Cornell box"] = (
                box,
                lambda side: sized("cbox/scene.xml", side) | {"max_depth": "8"},
            )
    return found


def picture(renderer: MitsubaRenderer, count: int) -> NDArray[np.float64]:
    """Return the mean of so many samples of every pixel, (H, W, 3)."""
    mean = _drawn(renderer, 0, count).radiance.reshape(-1, count, 3).mean(1, dtype=np.float64)
    image: NDArray[np.float64] = mean.reshape(*renderer.size, 3)
    return image


def _drawn(renderer: MitsubaRenderer, first: int, count: int) -> Samples:
    pixels = np.arange(renderer.size[0] * renderer.size[1])
    return renderer.sample(pixels, np.full_like(pixels, first), np.full_like(pixels, count))


def seconds(
    contenders: dict[str, Callable[[int], object]], rounds: int, before: int = 1
) -> dict[str, float]:
    """Return the median processor time of each, of interleaved rounds, and others before them."""
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(rounds + before):
        for name in record.in_turn(contenders, number):
            start = time.process_time()
            contenders[name](number)
            if number >= before:
                spent[name].append(time.process_time() - start)
    return {name: statistics.median(each) for name, each in spent.items()}


def of_scene(path: Path, parameters: Parameters, sizes: dict[str, int]) -> dict[str, Any]:
    """Return what is measured of a scene."""

    def made() -> MitsubaRenderer:
        return MitsubaRenderer(path, parameters(sizes["side"]), seed=1)

    whole = made()
    needs = whole.needs
    without: dict[str, MitsubaRenderer] = {}
    if needs.integrator != "path":
        without["media"] = made()
        without["media"].simulate(needs.max_depth)
    if not needs.media:
        for cut in CUTS:
            if needs.max_depth is None or cut < needs.max_depth:
                without[f"over {cut} segments"] = made()
                without[f"over {cut} segments"].simulate(cut)
    spent = seconds(
        {
            name: partial(lambda of, number: _drawn(of, 16 * number, 16), renderer)
            for name, renderer in {"all": whole, **without}.items()
        },
        sizes["rounds"],
    )
    metric = VDM(PPD, Display.linear(WHITE))
    # Without media other numbers are drawn: there the same path in both.
    reference = without["media"] if "media" in without and not needs.media else whole
    converged = picture(reference, sizes["count"])
    lost = {
        name: float(difference(metric, picture(renderer, sizes["count"]), converged).max())
        for name, renderer in without.items()
    }
    return {
        "asked": [needs.integrator, needs.max_depth],
        "microseconds": spent["all"] / (16 * sizes["side"] ** 2) * 1e6,
        "without": {
            name: {"time": spent[name] / spent["all"], "jnd": lost[name]} for name in without
        },
        "run": of_run(path, parameters(sizes["run"]), sizes, partial(_missing, path, parameters)),
    }


def _missing(path: Path, parameters: Parameters, sizes: dict[str, int], depth: int) -> float:
    """Return how far the converged pictures of a plan with a cut and of all paths differ, JND."""
    pictures = []
    for most in (None, depth):
        renderer = MitsubaRenderer(path, parameters(sizes["side"]), seed=2)
        renderer.simulate(renderer.needs.max_depth if most is None else most)
        pictures.append(picture(renderer, sizes["count"]))
    return float(difference(VDM(PPD, Display.linear(WHITE)), *pictures).max())


def of_run(
    path: Path,
    parameters: dict[str, str],
    sizes: dict[str, int],
    missing: Callable[[dict[str, int], int], float],
) -> dict[str, Any]:
    """Return what whole runs cost with everything and with what is needed."""
    results = {}

    def once(effects: str, _: int) -> None:
        results[effects] = render(
            path,
            TOLERANCE,
            PPD,
            WHITE,
            effects=effects,
            parameters=parameters,
            max_spp=sizes["most"],
            seed=3,
        )

    # Code is compiled for every scene that is loaded: that is part of a run.
    both: dict[str, Callable[[int], object]] = {
        name: partial(once, name) for name in ("full", "auto")
    }
    spent = seconds(both, sizes["runs"], before=0)
    auto, full = results["auto"], results["full"]
    plan = auto.figures["plan"]
    cut = plan["evidence"].get("segments") if plan["left_out_jnd"] else None
    return {
        "seconds": spent,
        "spp": {name: each.figures["spp_mean"] for name, each in results.items()},
        "stop_reason": {name: each.stop_reason for name, each in results.items()},
        "same_bits": bool(np.array_equal(auto.image, full.image)),
        "left_out": plan["left_out"],
        "kept": plan["kept"],
        "bound_jnd": plan["left_out_jnd"],
        "missing_jnd": missing(sizes, cut) if cut is not None else 0.0,
    }


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write transport.json, .md and .png to ``output``."""
    torch.set_num_threads(THREADS)
    sizes = QUICK if quick else FULL
    result: dict[str, Any] = {
        **record.circumstances(),
        "sizes": sizes,
        "tolerance": TOLERANCE,
        "scenes": {},
    }
    text = ""
    for name, (path, parameters) in scenes(quick).items():
        result["scenes"][name] = of_scene(path, parameters, sizes)
        text = table(result)
        # Written after each scene, for all of them take long.
        if output is not None:
            record.save(output, "transport", result, text)
            plot(result, output / "transport.png")
    print(text)


def table(result: dict[str, Any]) -> str:
    """Return the tables in Markdown."""
    sizes, found = result["sizes"], result["scenes"]
    names = ["media", *(f"over {cut} segments" for cut in CUTS)]
    lines = [
        "# What each effect of light costs, and what leaving it out would show",
        "",
        record.caption(result),
        "",
        "Processor time of a sample without an effect over that with all, and the largest visible "
        f"difference that it makes to the converged picture, JND ({sizes['side']}x{sizes['side']}, "
        f"{sizes['count']} samples of the same random numbers).",
        "",
        "| scene | asks for | us a sample | " + " | ".join(f"no {name}" for name in names) + " |",
        "|---|---|---|" + "---|" * len(names),
    ]
    for name, of in found.items():
        cells = [
            f"{cell['time']:.2f}, {cell['jnd']:.2f}" if cell else ""
            for cell in (of["without"].get(effect) for effect in names)
        ]
        integrator, depth = of["asked"]
        lines.append(
            f"| {OWN.get(name, name)} | {integrator}, {depth or 'any depth'} | "
            f"{of['microseconds']:.2f} | " + " | ".join(cells) + " |"
        )
    lines += [
        "",
        f"Whole runs at {result['tolerance']:g} JND, {sizes['run']}x{sizes['run']}, at most "
        f"{sizes['most']} samples a pixel: processor seconds with everything and with what is "
        "needed, decisions and all; what is missing in the converged picture.",
        "",
        "| scene | full, s | auto, s | times as fast | samples a pixel | same bits | bound, JND | "
        "missing, JND | what is left out, or why it is kept |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, of in found.items():
        each = of["run"]
        lines.append(
            f"| {OWN.get(name, name)} | {each['seconds']['full']:.1f} | "
            f"{each['seconds']['auto']:.1f} | {_times(of):.2f} | {each['spp']['full']:.0f}, "
            f"{each['spp']['auto']:.0f} | {'yes' if each['same_bits'] else 'no'} | "
            f"{each['bound_jnd']:.2f} | {each['missing_jnd']:.2f} | "
            + "; ".join(
                [f"left out: {words}" for words in each["left_out"]]
                + [f"kept: {words}" for words in each["kept"]]
            )
            + " |"
        )
    lines += ["", "| target | wanted | found | |", "|---|---|---|---|"]
    for name in ASK_TOO_MUCH:
        if name in found:
            times = _times(found[name])
            verdict = "met" if times >= FASTER else "**not met**"
            lines.append(f"| {OWN[name]}, times as fast | {FASTER} | {times:.2f} | {verdict} |")
    needy = [1.0 / _times(of) for of in found.values() if of["run"]["same_bits"]]
    if needy:
        verdict = "met" if max(needy) <= SLOWER else "**not met**"
        lines.append(
            f"| everything kept, times as slow, the worst | {SLOWER} | {max(needy):.2f} | "
            f"{verdict} |"
        )
    missing = max(of["run"]["missing_jnd"] for of in found.values()) / result["tolerance"]
    verdict = "met" if missing <= SHARE else "**not met**"
    lines.append(f"| missing, of the tolerance, the worst | {SHARE} | {missing:.2f} | {verdict} |")
    return "\n".join(lines) + "\n"


def _times(of: dict[str, Any]) -> float:
    return times_as_fast(of["run"])


def times_as_fast(of: dict[str, Any]) -> float:
    """Return how many times as fast ``auto`` is as ``full``, by their ``seconds``."""
    return float(of["seconds"]["full"] / of["seconds"]["auto"])


def draw_times(axes: Any, names: Sequence[str], times: Sequence[float]) -> None:
    """Draw how many times as fast ``auto`` is, a bar each."""
    axes.barh(range(len(names)), times, color="C0")
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.invert_yaxis()
    axes.axvline(1.0, color="0.3", linewidth=0.8)
    axes.set_xlabel('times as fast with effects="auto"')


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw what each effect saves against what leaving it out shows, and what auto saves."""
    figure = record.blank_figure(9.0, 4.8)
    left, right = figure.subplots(1, 2)
    found = result["scenes"]
    for number, (name, of) in enumerate(found.items()):
        cells = list(of["without"].items())
        left.plot(
            [cell["time"] for _, cell in cells],
            [max(cell["jnd"], 1e-3) for _, cell in cells],
            ".-",
            color=f"C{number}",
            label=OWN.get(name, name),
        )
    left.axhline(SHARE * result["tolerance"], color="0.6", linewidth=0.8)
    left.set_yscale("log")
    left.set_xlabel("time of a sample without it, of all")
    left.set_ylabel("largest difference it makes, JND")
    left.set_title("Media, or paths over 2, 3, 4, ... segments left out", fontsize=10)
    figure.legend(loc="outside lower center", ncols=5, fontsize=7, frameon=False)
    draw_times(right, [OWN.get(name, name) for name in found], list(map(_times, found.values())))
    right.set_title(f"Whole runs, {result['tolerance']:g} JND", fontsize=10)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
