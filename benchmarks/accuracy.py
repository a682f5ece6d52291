"""What accuracy costs in time: error against human thresholds, and milliseconds at 1080p.

At every human threshold a metric's value should be one constant. A contender's error at a threshold
is the change of contrast, in dB, that would bring its value there to the constant that serves it
best; what counts is the rms by mechanism. The two parts, errors and times, are measured apart: each
replaces its own half of accuracy.json, so that times can be taken on a quiet machine.
"""

import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks import record
from benchmarks.calibrate import HIGHEST_CONTRAST, MECHANISMS, by_mechanism, centred
from benchmarks.daly import PSYCHOMETRIC, detection_probability
from benchmarks.peers import Peer, clipped, installed
from benchmarks.pictures import distorted, photographs
from benchmarks.rungs import RUNGS
from benchmarks.speed import images, peak_megabytes
from benchmarks.thresholds import Threshold, pattern, read_thresholds, render, sampling
from torch_vdm import VDM, Display, Effects, Haar, Observer, StationaryHaar
from torch_vdm.model.cortex import Transform

Array = NDArray[np.float64]

# Steps of contrast around a threshold, dB; between them a metric's value is interpolated.
STEPS = (-12.0, -6.0, 0.0, 6.0, 12.0)

# An error is held to this, dB: a metric that is blind to a stimulus would have an infinite one.
LIMIT = 40.0

# Every how many rows of the table are drawn, and how: pixels in a cycle at most, and the phase.
# Status: choice.
EVERY, QUICK_EVERY = 12, 160
CYCLE, PHASE = 8.0, 0.4

# Values below this are none. Status: choice.
SMALLEST = 1e-12

# A probability of 1 counts as the largest number below it.
SUREST = 1.0 - 2.0**-53

# The grating experiments: pixels/degree, cycles/degree, phases, light of white in cd/m2.
PPD, WHITE = 64.0, 200.0
FREQUENCIES = (1.0, 2.0, 3.0, 4.0, 5.0, 8.0, 11.3)
PHASES = 4

# Those by which maps are compared with Sarnoff's.
DISTORTIONS = ("noise", "blur", "JPEG", "grating")

FULL_HD = (1080, 1920)
THREADS = 2
PAPERS_RATIO = 60.0

# Contenders that take no more seconds are timed in so many times as many rounds. Status: choice.
QUICK_SECONDS, QUICK_ROUNDS = 1.0, 4

HALFWAY: dict[str, Transform] = {
    "Haar, CSF before": Haar("filter"),
    "StationaryHaar": StationaryHaar(),
}


def ours(precision: torch.dtype = torch.float32, autocast: bool = False, **options: Any) -> Any:
    """Return the figures of a VDM, as `Peer.values`: its detection score."""

    def values(tests: Tensor, reference: Tensor, ppd: float) -> Tensor:
        metric = VDM(ppd, Display.xyz(), **options)
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            score = metric.score(
                tests.to(precision), reference.to(precision).expand_as(tests).contiguous()
            )
        return score.double().view(-1, 1)

    return values


def sarnoff(tests: Tensor, reference: Tensor, ppd: float) -> Tensor:
    """Return mean and maximum of Sarnoff's map, as `Peer.values`.

    On the image's own grid: coarse gratings would be resampled to images of many megapixels. Its
    pixels are not taken for larger than a degree.
    """
    metric = VDM.sarnoff(max(ppd, 1.0), Display.xyz(), resample=False)
    seen = metric(tests.float(), reference.float().expand_as(tests))
    flat = seen.double().flatten(1)
    return torch.stack((flat.mean(1), flat.amax(1)), 1)


def daly(tests: Tensor, reference: Tensor, ppd: float) -> Tensor:
    """Return what Daly's probabilities of detection come to, as `Peer.values`.

    At the pixel where it is largest, and over all pixels together, each as the contrast of its
    psychometric function, which tells probabilities near 1 apart.
    """
    figures = []
    for test in tests.split(1):
        seen = detection_probability(test, reference, ppd, Display.xyz())
        missed = -torch.log1p(-seen.clamp_max(SUREST))
        figures.append(torch.stack((missed.amax(), missed.sum())))
    return torch.stack(figures) ** (1.0 / PSYCHOMETRIC)


def contenders() -> dict[str, Any]:
    """Return everything of ours that is judged by human thresholds."""
    without = {
        f"fast, without {name}": ours(effects=Effects(**{name: False}))
        for name in Effects().names()
    }
    return {
        **{name: ours(transform=transform) for name, transform in (RUNGS | HALFWAY).items()},
        "paper's observer": ours(observer=Observer.paper()),
        "Sarnoff": sarnoff,
        "Daly": daly,
        **without,
        "fast, float64": ours(torch.float64),
        "fast, bfloat16 autocast": ours(autocast=True),
        "fast, bfloat16 images": ours(torch.bfloat16),
    }


# The arithmetic of the human test


def contrast_for(constant: float, steps: Array, values: Array) -> float:
    """Return the contrast in dB at which a metric's value is ``constant``.

    ``values`` at contrasts of ``steps`` dB, made monotone, interpolated in the logarithm, and
    beyond both ends continued as between the last two; within `LIMIT`.
    """
    logs = np.log(np.maximum(np.maximum.accumulate(values), SMALLEST))
    # Equal values would have no inverse.
    logs = logs + 1e-9 * np.arange(len(logs))
    wanted = math.log(max(constant, SMALLEST))
    if len(steps) > 1 and wanted < logs[0]:
        found = steps[0] + (wanted - logs[0]) * (steps[1] - steps[0]) / (logs[1] - logs[0])
    elif len(steps) > 1 and wanted > logs[-1]:
        found = steps[-1] + (wanted - logs[-1]) * (steps[-1] - steps[-2]) / (logs[-1] - logs[-2])
    else:
        found = np.interp(wanted, logs, steps)
    return float(np.clip(found, -LIMIT, LIMIT))


def errors_at(constant: float, curves: list[tuple[Array, Array]]) -> Array:
    """Return the errors, dB, of all thresholds; a curve is its steps and the values there."""
    return np.array([contrast_for(constant, *curve) for curve in curves])


def best_constant(curves: list[tuple[Array, Array]]) -> tuple[float, Array]:
    """Return the constant with the least rms error, and the errors with it.

    Of those between the least and the greatest value at threshold, in steps of 1 % of their
    logarithm's range, and then of a hundredth of that.
    """
    at = [
        max(float(np.exp(np.interp(0.0, steps, np.log(np.maximum(values, SMALLEST))))), SMALLEST)
        for steps, values in curves
    ]
    low, high = math.log(min(at)), math.log(max(at))
    best = low
    for _ in range(2):
        tried = np.linspace(low, high, 101)
        rms = [float(np.mean(errors_at(math.exp(k), curves) ** 2)) for k in tried]
        best = float(tried[int(np.argmin(rms))])
        step = (high - low) / 100.0
        low, high = best - step, best + step
    return math.exp(best), errors_at(math.exp(best), curves)


def judged(curves: list[tuple[Array, Array]], thresholds: list[Threshold]) -> dict[str, Any]:
    """Return a contender's rms errors, of the figure that serves it best where it has several.

    A curve's values are (steps, figures).
    """
    results = []
    achromatic = np.array([t.mechanism == "achromatic" for t in thresholds])
    for figure in range(curves[0][1].shape[1]):
        own = [(steps, values[:, figure]) for steps, values in curves]
        constant, error = best_constant(own)
        alone = best_constant([c for c, a in zip(own, achromatic, strict=True) if a])[1]
        results.append(
            {
                "constant": constant,
                "all": float(np.sqrt(np.mean(error**2))),
                "by_mechanism": by_mechanism(error, thresholds),
                "one_gain_a_study": by_mechanism(centred(error, thresholds), thresholds),
                "achromatic_alone": float(np.sqrt(np.mean(alone**2))),
                "at_the_limit": int((np.abs(error) >= LIMIT).sum()),
            }
        )
    return min(results, key=lambda r: float(r["all"]))


def curve_of(threshold: Threshold, values: Any) -> tuple[Array, Array]:
    """Return the steps that can be shown as light, and a contender's figures there."""
    largest = max(map(abs, threshold.contrast))
    steps = [s for s in STEPS if s <= 0.0 or largest * 10.0 ** (s / 20.0) < 0.97]
    ppd = sampling(threshold, CYCLE)
    drawn = pattern(threshold, ppd, PHASE)
    tests = torch.cat([render(threshold, drawn, 10.0 ** (s / 20.0)) for s in steps])
    with torch.no_grad():
        found = values(tests, render(threshold, drawn, 0.0), ppd)
    return np.array(steps), found.double().numpy()


# Gratings and pictures


def grating(cycles: float, contrast: float, phase: float = 0.0, angle: float = 0.0) -> Tensor:
    """Return a grating (1, 3, 128, 128), linear, of mean 0.5; cycles a pixel, degrees."""
    y, x = torch.meshgrid(*2 * (torch.arange(128, dtype=torch.float64),), indexing="ij")
    along = x * math.cos(math.radians(angle)) + y * math.sin(math.radians(angle))
    wave = torch.sin(2.0 * math.pi * cycles * along + phase)
    return (0.5 * (1.0 + contrast * wave)).expand(1, 3, 128, 128).contiguous()


def gratings(value: Any, metric: Any, frequencies: tuple[float, ...]) -> dict[str, Any]:
    """Return how a grating's threshold swings with its phase and direction, and its map's evenness.

    ``value`` gives (N,) figures, 1 at threshold, of (N, 3, H, W) twice.
    """
    spread, turned, uneven = {}, {}, {}
    phases = [step * math.pi / PHASES for step in range(PHASES)]
    for cpd in frequencies:
        unit = torch.cat([grating(cpd / PPD, 1.0, p, a) for a in (0.0, 45.0) for p in phases])
        flat = torch.full_like(unit, 0.5)
        contrast = torch.full((len(unit), 1, 1, 1), 0.004, dtype=torch.float64)
        for _ in range(3):
            seen = value(flat + contrast * (unit - flat), flat)
            contrast = contrast / seen.view(-1, 1, 1, 1)
        found = 20.0 * torch.log10(contrast).view(2, PHASES)
        spread[str(cpd)] = float((found.amax(1) - found.amin(1)).max())
        turned[str(cpd)] = float(found[0].mean() - found[1].mean())
        inner = metric(grating(cpd / PPD, 0.02), flat[:1])[0, 0, 32:96, 32:96]
        low, high = inner.quantile(0.05), inner.quantile(0.95)
        uneven[str(cpd)] = float(20.0 * torch.log10(high / low))
    return {"phase_db": spread, "orientation_db": turned, "unevenness_db": uneven}


def pictures(quick: bool) -> dict[str, tuple[Tensor, Tensor]]:
    """Return pairs of test and reference, sRGB-coded (1, 3, H, W): photographs and a scene."""
    # Without the shared photographs the scene alone is judged.
    pairs: dict[str, tuple[Tensor, Tensor]] = {}
    generator = torch.Generator().manual_seed(1)
    for name, photo in photographs(1 if quick else 5).items():
        tests = distorted(photo, generator)
        pairs |= {f"{kind}, {name}": (tests[kind], photo) for kind in DISTORTIONS}
    scene = chapel(generator)
    noise = 0.04 * torch.randn(scene.shape, generator=generator)
    pairs["chapel"] = ((scene + noise).clamp(0.0, 1.0), scene)
    return pairs


def chapel(generator: torch.Generator) -> Tensor:
    """Return a scene (1, 3, 256, 256), sRGB-coded: dark, bright and busy thirds, as in Fig. 1."""
    scene = torch.full((1, 3, 256, 256), 0.06)
    scene[..., 85:170] = 0.7
    busy = torch.rand(1, 1, 128, 43, generator=generator).repeat_interleave(2, 2)
    scene[..., 170:] = 0.3 + 0.4 * busy.repeat_interleave(2, 3)[..., :86]
    return scene


def like_sarnoff(metric: Any, pairs: dict[str, tuple[Tensor, Tensor]]) -> dict[str, Any]:
    """Return the correlation of a metric's map with Sarnoff's by kind, and the scene's regions."""
    sarnoff_metric = VDM.sarnoff(60.0)
    found: dict[str, list[float]] = {}
    regions = {}
    with torch.no_grad():
        for name, pair in pairs.items():
            seen, theirs = metric(*pair), sarnoff_metric(*pair)
            both = torch.stack((seen.flatten(), theirs.flatten()))
            found.setdefault(name.partition(",")[0], []).append(float(torch.corrcoef(both)[0, 1]))
            if name == "chapel":
                thirds = (("dark", 8, 77), ("bright", 93, 162), ("busy", 178, 248))
                regions = {part: float(seen[..., a:b].mean()) for part, a, b in thirds}
    return {"correlation": {k: statistics.mean(v) for k, v in found.items()}, "chapel": regions}


def errors(
    quick: bool, before: dict[str, Any], progress: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Measure everything but time; ``progress`` is given what there is so far.

    What an interrupted run left ``before`` is taken over, if rows and observer are the same.
    """
    used = [
        t
        for t in read_thresholds()
        if t.stimulus != "disk" and max(map(abs, t.contrast)) <= HIGHEST_CONTRAST
    ]
    rows = used[:: QUICK_EVERY if quick else EVERY]
    peers, missing = installed()
    both = [(render(t, pattern(t, sampling(t, CYCLE), PHASE), 1.0), t.luminance) for t in rows]
    observer = Observer.calibrated().numbers()
    result: dict[str, Any] = {
        "complete": False,
        "rows": len(rows),
        "observer": observer,
        "clipped_rows": sum(clipped(*pair) for pair in both),
        "missing": missing,
        "human": {},
        "held_out": _held_out(),
        "gratings": {},
        "pictures": {},
    }
    if not before.get("complete", True) and (before["rows"], before["observer"]) == (
        len(rows),
        observer,
    ):
        result |= {kind: before[kind] for kind in ("human", "gratings", "pictures")}
    everyone = contenders()
    if quick:
        everyone = {n: v for n, v in everyone.items() if n in ("fast", "Haar, CSF before")}
        peers = [peer for peer in peers if peer.name == "SSIM"]
    # The dearest last.
    ordered = everyone | {peer.name: peer.values for peer in peers}
    for name, values in sorted(ordered.items(), key=lambda item: item[0] == "reference"):
        if name in result["human"]:
            continue
        start = time.process_time()
        try:
            result["human"][name] = judged([curve_of(t, values) for t in rows], rows)
        except Exception as error:  # a peer's own failure is a result
            if name in everyone:
                raise
            result["missing"][name] = f"failed: {type(error).__name__}: {error}"
        print(f"{name}: {time.process_time() - start:.0f} s", file=sys.stderr, flush=True)
        progress(result)
    pairs = pictures(quick)
    transforms: dict[str, Transform] = {"fast": RUNGS["fast"]} if quick else RUNGS | HALFWAY
    for name, transform in transforms.items():
        if name in result["pictures"]:
            continue
        metric = VDM(PPD, Display.linear(WHITE), transform=transform)
        with torch.no_grad():
            frequencies = FREQUENCIES[1:2] if quick else FREQUENCIES
            result["gratings"][name] = gratings(metric.score, metric, frequencies)
        result["pictures"][name] = like_sarnoff(VDM(60.0, transform=transform), pairs)
        progress(result)
    return result | {"complete": True}


def _held_out() -> dict[str, float]:
    """Return the errors of `fast` on studies that its fit did not see: those of calibrate.json."""
    path = Path(__file__).parent / "results" / "calibrate.json"
    rungs = json.loads(path.read_text())["rungs"]
    figures: dict[str, float] = rungs["fast"]["leave_one_study_out"]
    return figures


# Time and memory


def timed() -> dict[str, Callable[[], Any]]:
    """Return everything that is timed, as makers of functions of test and reference."""
    sarnoff_here = partial(VDM.sarnoff, resample=False)
    makers: dict[str, Callable[[], Any]] = {
        **{name: partial(VDM, transform=t) for name, t in (RUNGS | HALFWAY).items()},
        **{
            f"{n} compiled": partial(_compiled, partial(VDM, transform=t)) for n, t in RUNGS.items()
        },
        "paper's observer": VDM.paper,
        "Sarnoff": VDM.sarnoff,
        "Sarnoff compiled": partial(_compiled, VDM.sarnoff),
        "Sarnoff, same grid": sarnoff_here,
        "Sarnoff, same grid compiled": partial(_compiled, sarnoff_here),
        **{
            f"fast, without {name}": partial(VDM, effects=Effects(**{name: False}))
            for name in Effects().names()
        },
        "fast, float64": partial(_in, torch.float64),
        "fast, bfloat16 autocast": _autocast,
        "fast, bfloat16 images": partial(_in, torch.bfloat16),
    }
    for peer in installed()[0]:
        makers[peer.name] = partial(_timed, peer)
    return makers


def _timed(peer: Peer) -> Callable[[Tensor, Tensor], Any]:
    return peer.timed


def _compiled(make: Callable[[], Any]) -> Any:
    return make().compile()


def _in(dtype: torch.dtype) -> Callable[[Tensor, Tensor], Tensor]:
    metric = VDM()
    return lambda test, reference: metric(test.to(dtype), reference.to(dtype))


def _autocast() -> Callable[[Tensor, Tensor], Tensor]:
    metric = VDM()

    def call(test: Tensor, reference: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            seen: Tensor = metric(test, reference)
            return seen

    return call


# What has no gradient in its package.
NO_GRADIENT = ("FLIP", "ColorVideoVDP")


def _once(call: Any, test: Tensor, reference: Tensor, backward: bool) -> float:
    """Return the seconds of one call."""
    start = time.perf_counter()
    if backward:
        call(test.clone().requires_grad_(), reference).mean().backward()
    else:
        with torch.no_grad():
            call(test, reference)
    return time.perf_counter() - start


def interleaved(
    makers: dict[str, Callable[[], Any]], size: tuple[int, int], rounds: int, backward: bool
) -> dict[str, float]:
    """Return the median milliseconds of each; every round calls each once, the first for warmth.

    The quick ones are called in `QUICK_ROUNDS` times as many rounds: what strikes a moment of the
    machine is the more of their time.
    """
    test, reference = images(size)
    calls = {name: make() for name, make in makers.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(QUICK_ROUNDS * rounds + 1):
        for name, call in calls.items():
            if number > rounds and statistics.median(seconds[name]) > QUICK_SECONDS:
                continue
            taken = _once(call, test, reference, backward)
            if number > 0:
                seconds[name].append(taken)
    return {name: 1e3 * statistics.median(values) for name, values in seconds.items()}


def times(quick: bool, progress: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Measure milliseconds, peak memory and the ratios to Sarnoff's model.

    ``progress`` is given what there is so far.
    """
    torch.set_num_threads(THREADS)
    size = (96, 128) if quick else FULL_HD
    rounds = 1 if quick else 3
    everyone = timed()
    chosen = everyone
    if quick:
        chosen = {n: m for n, m in everyone.items() if n in ("fast", "SSIM")}
    differentiable = {
        n: m for n, m in chosen.items() if n not in NO_GRADIENT and "Sarnoff" not in n
    }
    # The backward pass of the dear ones would take most of the time and more of the memory.
    losses = {n: m for n, m in differentiable.items() if "reference" not in n}
    result: dict[str, Any] = {
        "size": size,
        "threads": THREADS,
        "rounds": rounds,
        "forward_ms": interleaved(chosen, size, rounds, False),
        "backward_ms": {},
        "peak_extra_megabytes": {},
        "sarnoff_ratios": {},
    }
    progress(result)
    result["backward_ms"] = interleaved(losses, size, max(1, rounds - 1), True)
    progress(result)
    names = ("fast", "fast compiled", *(n for n in everyone if n.startswith("Sarnoff")))
    for here in () if quick else ((512, 512), FULL_HD):
        found = interleaved({n: everyone[n] for n in names}, here, 5, False)
        ratios = {
            "same grid, eager": found["Sarnoff, same grid"] / found["fast"],
            "same grid, best": found["Sarnoff, same grid compiled"] / found["fast compiled"],
            "120 pixels/degree, eager": found["Sarnoff"] / found["fast"],
            "120 pixels/degree, best": found["Sarnoff compiled"] / found["fast compiled"],
        }
        result["sarnoff_ratios"][f"{here[1]}x{here[0]}"] = {"ms": found, "ratios": ratios}
        progress(result)
    for name in chosen:
        if not quick and "compiled" not in name and not name.startswith("fast,"):
            ways = (False, True) if name in losses else (False,)
            result["peak_extra_megabytes"][name] = [_memory(name, size, way) for way in ways]
            progress(result)
    return result


def _memory(name: str, size: tuple[int, int], backward: bool) -> float:
    """Return the MB that a call takes at most over what stood before, in a new process."""
    return record.measured_apart("accuracy", name, *size, backward)["megabytes"]


def _peak(name: str, size: tuple[int, int], backward: bool) -> float:
    torch.set_num_threads(THREADS)
    call = timed()[name]()
    _once(call, *images((192, 192)), backward)
    test, reference = images(size)
    return peak_megabytes(lambda: _once(call, test, reference, backward))


# The result


def run(quick: bool, output: Path | None, part: str | None = None) -> None:
    """Measure both parts or one, print the table, and write accuracy.json, .md and .png."""
    path = None if output is None else output / "accuracy.json"
    result: dict[str, Any] = {}
    if path is not None and path.exists():
        result = json.loads(path.read_text())

    def keep(name: str, measured: dict[str, Any]) -> None:
        result[name] = {**record.circumstances(), **measured}
        if output is not None:
            record.save(output, "accuracy", result, table(result))

    if part in (None, "errors"):
        before = result.get("errors", {})
        keep("errors", errors(quick, before, lambda found: keep("errors", found)))
    if part in (None, "times"):
        keep("times", times(quick, lambda found: keep("times", found)))
    print(table(result))
    if output is not None and "errors" in result and "times" in result:
        plot(result, output / "accuracy.png")


def table(result: dict[str, Any]) -> str:
    """Return the result in Markdown."""
    lines = ["# What accuracy costs in time", ""]
    found, cost = result.get("errors"), result.get("times")
    milliseconds = cost["forward_ms"] if cost else {}
    backward = cost["backward_ms"] if cost else {}
    if found:
        lines += [f"Errors: {record.caption(found)}.", ""]
        lines += [
            f"rms error in dB at {found['rows']} human thresholds (every {EVERY}th of the table, "
            "no discs): the contrast change that brings a metric's value to its best constant, one "
            "for all rows; *achromatic alone*: its best constant for these. Ours were fitted to "
            "this table with `fast`; on studies that the fit did not see, `fast` has, with one "
            "gain a study: "
            + ", ".join(f"{name} {error:.1f}" for name, error in found["held_out"].items())
            + ". Peers without luminance see an sRGB image whose white is 4 times the background; "
            f"{found['clipped_rows']} of the rows are clipped there.",
            "",
        ]
    if cost:
        lines += [f"Times: {record.caption(cost)}.", ""]
    if found:
        heads = [
            "all",
            *MECHANISMS,
            "achromatic alone",
            "one gain a study: achromatic",
            "ms",
            "ms, with backward",
        ]
        lines += ["| | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
        for name, judged_so in found["human"].items():
            kinds = judged_so["by_mechanism"]
            cells = [f"{judged_so['all']:.1f}"]
            cells += [f"{kinds[m]:.1f}" if m in kinds else "" for m in MECHANISMS]
            cells += [f"{judged_so['achromatic_alone']:.1f}"]
            cells += [f"{judged_so['one_gain_a_study'].get('achromatic', math.nan):.1f}"]
            for kind in (milliseconds, backward):
                cells.append(f"{kind[name]:.0f}" if name in kind else "")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines += ["", "Not here: " + "; ".join(f"{n}: {w}" for n, w in found["missing"].items())]
        if found["gratings"]:
            lines += _more(found)
    if cost and cost["sarnoff_ratios"]:
        heads = list(next(iter(cost["sarnoff_ratios"].values()))["ratios"])
        lines += ["", "Sarnoff's time (one channel) over `fast`'s (three):", ""]
        lines += ["| | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
        for size, both in cost["sarnoff_ratios"].items():
            cells = [f"{ratio:.1f}" for ratio in both["ratios"].values()]
            lines.append(f"| {size} | " + " | ".join(cells) + " |")
    if cost:
        lines += ["", "| peak extra MB | forward | with backward |", "|---|---|---|"]
        for name, peaks in cost["peak_extra_megabytes"].items():
            lines.append(f"| {name} | " + " | ".join(f"{peak:.0f}" for peak in peaks) + " |")
    return "\n".join(lines) + "\n"


def _more(found: dict[str, Any]) -> list[str]:
    """Return the tables of gratings and of pictures."""
    heads = ["phase, worst dB", "0 to 45 degrees, worst dB", "map's unevenness, worst dB"]
    kinds = list(next(iter(found["pictures"].values()))["correlation"])
    heads += [f"like Sarnoff's: {kind}" for kind in kinds]
    heads += ["chapel: dark / bright / busy, JND"]
    lines = [
        "",
        f"Gratings at {', '.join(f'{f:g}' for f in FREQUENCIES)} cycles/degree, {PPD:g} "
        "pixels/degree; the map's correlation with Sarnoff's on photographs and on a scene.",
        "",
        "| | " + " | ".join(heads) + " |",
        "|---|" + "---|" * len(heads),
    ]
    for name, swings in found["gratings"].items():
        cells = [
            f"{max(map(abs, swings[kind].values())):.1f}"
            for kind in ("phase_db", "orientation_db", "unevenness_db")
        ]
        cells += [f"{found['pictures'][name]['correlation'][kind]:.2f}" for kind in kinds]
        chapel_of = found["pictures"][name]["chapel"]
        cells.append(" / ".join(f"{seen:.2f}" for seen in chapel_of.values()))
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw error against time: the ladder as a line, peers as points, the paper's 1/60 marked."""
    human, cost = result["errors"]["human"], result["times"]["forward_ms"]
    held_out = result["errors"]["held_out"]
    figure = record.blank_figure(9.6, 4.6)
    axes = figure.subplots(1, 2, sharex=True)
    alike = {name: of["one_gain_a_study"]["achromatic"] for name, of in human.items()}
    panels = (
        ("achromatic, one gain a study", alike),
        ("all mechanisms, one constant", {name: of["all"] for name, of in human.items()}),
    )
    for axis, (title, error) in zip(axes, panels, strict=True):
        rungs = [(cost[n], error[n]) for n in RUNGS if n in human and n in cost]
        axis.plot(*zip(*rungs, strict=True), "o-", color="#3b5b92", label="VDM", zorder=3)
        for name in RUNGS:
            if name in human and name in cost:
                _label(axis, name, cost[name], error[name], "#3b5b92")
        for names, marker, colour, label in (
            (list(HALFWAY), "s", "#7a9bd0", "half-way to standard"),
            (["Sarnoff", "paper's observer"], "D", "#8a6d3b", "older models"),
            (["SSIM", "MS-SSIM", "FLIP", "ColorVideoVDP"], "^", "#b23a3a", "peers"),
        ):
            shown = [n for n in names if n in human and n in cost]
            if shown:
                axis.plot(
                    [cost[n] for n in shown],
                    [error[n] for n in shown],
                    marker,
                    color=colour,
                    label=label,
                )
            for name in shown:
                _label(axis, name, cost[name], error[name], colour)
        if axis is axes[0] and "fast" in cost:
            axis.plot(
                cost["fast"],
                held_out["achromatic"],
                "o",
                markerfacecolor="none",
                color="#3b5b92",
                label="fast, on studies left out",
            )
        if "Sarnoff" in cost:
            axis.axvline(cost["Sarnoff"] / PAPERS_RATIO, color="grey", linestyle=":", linewidth=1)
            axis.text(
                cost["Sarnoff"] / PAPERS_RATIO,
                0.98,
                " Sarnoff / 60",
                transform=axis.get_xaxis_transform(),
                fontsize=7,
                va="top",
                color="grey",
            )
        axis.set_xscale("log")
        axis.margins(x=0.18, y=0.1)
        axis.set_ylim(bottom=0.0)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("milliseconds, 1920 x 1080, forward")
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("rms error at human thresholds, dB")
    axes[0].legend(frameon=False, fontsize=7, loc="center right", bbox_to_anchor=(1.0, 0.55))
    figure.savefig(path)


# Where a name stands beside its point, so that none covers another: to the right, but for these.
SIDES = {
    **dict.fromkeys(("StationaryHaar", "reference"), "below"),
    **dict.fromkeys(("fast", "paper's observer", "FLIP", "Sarnoff"), "left"),
    "Haar, CSF before": "above left",
    "standard": "above right",
}
PLACES: dict[str, Any] = {
    "below": {"xytext": (0, -6), "ha": "center", "va": "top"},
    "above left": {"xytext": (8, 6), "ha": "right", "va": "bottom"},
    "above right": {"xytext": (-8, 6), "ha": "left", "va": "bottom"},
    "left": {"xytext": (-7, 0), "ha": "right", "va": "center"},
    "right": {"xytext": (7, 0), "ha": "left", "va": "center"},
}


def _label(axis: Any, name: str, x: float, y: float, colour: str) -> None:
    place = PLACES[SIDES.get(name, "right")]
    axis.annotate(name, (x, y), textcoords="offset points", fontsize=7, color=colour, **place)


if __name__ == "__main__":
    size = int(sys.argv[2]), int(sys.argv[3])
    print(json.dumps({"megabytes": _peak(sys.argv[1], size, sys.argv[4] == "True")}))
