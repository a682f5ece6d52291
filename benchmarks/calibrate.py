"""The calibrated observer, fitted to human thresholds by running the metric on their stimuli.

At threshold `VDM.score` is to be 1. Every stimulus is drawn and decomposed; as long as its contrast
leaves the eye's adaptation as it is, a coefficient's weighted contrast is a number of its level,
its channel and its luminance alone times the coefficient at a contrast of 1. `VDM.respond` gives
that number for a coefficient of 1, and a histogram stands for the coefficients, so that a fit takes
seconds. What comes out is judged by `VDM.score` itself, on the stimuli as light.
"""

import dataclasses
import hashlib
import math
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, jacfwd

from benchmarks import record
from benchmarks.thresholds import (
    OFF_CENTRE,
    Threshold,
    background,
    pattern,
    read_thresholds,
    render,
    sampling,
)
from torch_vdm import VDM, Display, Effects, Observer
from torch_vdm.cortex import Cortex, Haar
from torch_vdm.masking import signed_transducer

MECHANISMS = ("achromatic", "red-green", "yellow-violet", "mixed")

# Pixels in a cycle (its upper end) and phase of the drawings of each stimulus. Status: choice: a
# user's display samples a cycle in any way.
DRAWINGS = ((8.0, 0.4), (11.3, 1.9), (16.0, 1.1), (5.7, 2.6))

# What is fitted, from a starting value and with a width in the logarithm: a weak belief that keeps
# what the data does not tell near what it was. Status: choice. Few, for what they predict must hold
# for thresholds that are not in the table; `Observer.calibrated` says of the others why they are
# held. The band's width is held near that of the curve alone: left free it narrows to 1.0, for
# coarse Haar levels respond to fine gratings too, and a grating of 12 cycles/degree would be seen
# by its traces at 3.
FREE = {
    "achromatic_gain": (340.0, 1.0),
    "dim_luminance": (20.0, 1.0),
    "achromatic_dimming": (0.2, 0.5),
    "glare_exponent": (0.4, 0.3),
    "peak_frequency": (3.5, 0.5),
    "peak_exponent": (0.2, 0.5),
    "band_width": (1.4, 0.05),
    "band_floor": (0.48, 0.5),
    "red_green_gain": (330.0, 1.0),
    "red_green_cutoff": (0.47, 1.0),
    "yellow_violet_gain": (200.0, 1.0),
    "yellow_violet_cutoff": (0.3, 1.0),
}

# A cone contrast over this is left out: over 1 it is no light. Status: choice.
HIGHEST_CONTRAST = 0.9

# The weight of rows whose colour direction is none of the three mechanisms, of which there are
# many from two studies; the residual in dB from which a row counts less; the rms in dB of the data
# against which beliefs are weighed. Status: choice.
MIXED_WEIGHT, OUTLIER, SPREAD = 0.3, 8.0, 3.0

# How strongly the mean of a mechanism's studies is held to 0, against one row. Status: choice: less
# lets the fit trade a mechanism's absolute sensitivity, which is what 1 JND means, for the shape of
# another.
ANCHOR = 100.0

# Levels that are looked at, from the finest; the logarithmic bins of coefficients.
LEVELS, BINS = 9, np.logspace(-4.5, 0.3, 121)

DECIBELS = 20.0 / math.log(10.0)
Array = NDArray[np.float64]


class _Responses(nn.Module):
    """The weighted contrast of a detail, as a module, so that its constants can be replaced."""

    def __init__(self, observer: Observer, ppd: float) -> None:
        super().__init__()
        effects = Effects(masking=False, pooling=False)
        self.metric = VDM(ppd, Display.xyz(), observer, effects=effects)

    def forward(self, cortex: Cortex) -> tuple[Tensor, ...]:
        return self.metric.respond(cortex)


class _View(NamedTuple):
    """The thresholds that are drawn at one sampling."""

    rows: list[int]
    """Their numbers."""
    responses: _Responses
    cortex: Cortex
    """A detail of their contrast on every level, on their background."""


def views(observer: Observer, thresholds: list[Threshold], ppds: Array) -> list[_View]:
    """Group thresholds by the pixels per degree at which they are drawn."""
    groups = defaultdict(list)
    for row, ppd in enumerate(ppds):
        groups[float(ppd)].append(row)
    found = []
    for ppd, rows in groups.items():
        light = torch.stack([background(thresholds[row].luminance) for row in rows])
        contrast = torch.stack([torch.tensor(thresholds[row].contrast).double() for row in rows])
        detail = (light * contrast).view(-1, 3, 1, 1, 1)
        plane = light.view(-1, 3, 1, 1)
        cortex = Cortex((detail,) * LEVELS, (plane,) * LEVELS, plane)
        found.append(_View(rows, _Responses(observer, ppd), cortex))
    return found


def gains(of: list[_View], free: dict[str, Tensor]) -> Tensor:
    """Return the weighted contrast of a coefficient of 1 at the thresholds' contrast.

    (rows, levels, channels), the finest level first.
    """
    constants = {f"metric.{name}": value for name, value in free.items()}
    found: dict[int, Tensor] = {}
    for view in of:
        responses = functional_call(view.responses, constants, (view.cortex,))
        levels = torch.stack([r[:, :, 0, 0, 0] for r in reversed(responses)], 1)
        found |= zip(view.rows, levels, strict=True)
    return torch.stack([found[row] for row in range(len(found))]).abs()


def histograms(thresholds: list[Threshold], cycle: float, phase: float, window: int) -> Array:
    """Return how many coefficients of each size one glance at a stimulus takes in.

    (rows, levels, bins), at a contrast of 1, weighted as `torch_vdm.pooling.glance` weighs them
    around the middle of the stimulus.
    """
    known: dict[tuple[Any, ...], Array] = {}
    rows = []
    for threshold in thresholds:
        ppd = sampling(threshold, cycle)
        key = (
            threshold.frequency,
            threshold.area,
            threshold.sigma,
            threshold.stimulus,
            threshold.orientation,
        )
        if key not in known:
            known[key] = _histogram(threshold, ppd, phase, window)
        rows.append(known[key])
    return np.stack(rows)


def _histogram(threshold: Threshold, ppd: float, phase: float, window: int) -> Array:
    drawn = pattern(threshold, ppd, phase)
    cortex = Haar().decompose(drawn[None, None])
    middle = drawn.shape[-1] / 2 + OFF_CENTRE * ppd / threshold.scale
    counts = np.zeros((LEVELS, len(BINS) - 1))
    for level, detail in enumerate(reversed(cortex.details[-LEVELS:])):
        nodes = torch.arange(detail.shape[-1]) + 0.5 - middle / 2.0 ** (level + 1)
        weight = (1.0 - nodes.abs() / window).clamp_min(0.0)
        weights = (weight[:, None] * weight).expand(detail.shape).numpy()
        counts[level] = np.histogram(detail.abs().numpy(), BINS, weights=weights)[0]
    return counts


class Model:
    """Predicts the thresholds of a list of rows from the free parameters."""

    def __init__(
        self,
        observer: Observer,
        thresholds: list[Threshold],
        drawings: tuple[tuple[float, float], ...],
    ) -> None:
        self.observer, self.thresholds = observer, thresholds
        self.views = [
            views(observer, thresholds, np.array([sampling(t, cycle) for t in thresholds]))
            for cycle, _ in drawings
        ]
        # The sum over a histogram, as a table over the logarithm of a level's gain.
        self.start, self.step = -12.0, 0.1
        grid = torch.arange(self.start, 14.0, self.step, dtype=torch.float64)
        sizes = torch.tensor(np.sqrt(BINS[1:] * BINS[:-1]))
        numbers = {k: torch.tensor(v, dtype=torch.float64) for k, v in observer.numbers().items()}
        contrast = torch.exp(grid)[:, None] * sizes
        response = signed_transducer(contrast[None, None, None], numbers["transducer_exponent"])
        powers = response[0, 0, 0] ** observer.score_exponent
        self.tables = []
        for cycle, phase in drawings:
            counts = torch.tensor(histograms(thresholds, cycle, phase, observer.score_window))
            self.tables.append(torch.log(counts @ powers.T + 1e-300))

    def log_gains(self, free: dict[str, Tensor]) -> Tensor:
        """Return the logarithm of `gains`, (drawings, rows, levels, channels)."""
        each = torch.stack([gains(drawn, free) for drawn in self.views])
        return torch.log(each.clamp_min(1e-12))

    def log_score(self, log_gains: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logarithm of the score, mean over the drawings, and its slope; (rows,)."""
        place = ((log_gains - self.start) / self.step).clamp(0.0, self.tables[0].shape[-1] - 1.001)
        low = place.detach().floor().long()
        scores, slopes = [], []
        for at, between, table in zip(low, place, self.tables, strict=True):
            below = table.gather(-1, at)
            rise = table.gather(-1, at + 1) - below
            terms = (below + rise * (between - at)).flatten(1)
            total = torch.logsumexp(terms, -1)
            scores.append(total - math.log(self.observer.score_coefficients))
            slopes.append((torch.softmax(terms, -1) * rise.flatten(1) / self.step).sum(-1))
        exponent = self.observer.score_exponent
        return torch.stack(scores).mean(0) / exponent, torch.stack(slopes).mean(0) / exponent

    def residual(self, free: dict[str, Tensor]) -> Tensor:
        """Return predicted over human threshold in dB, (rows,)."""
        log_gains = self.log_gains(free)
        times = torch.zeros(len(self.thresholds), dtype=torch.float64)
        # Newton on the logarithm of contrast; the last step carries the derivative.
        for _ in range(8):
            score, slope = self.log_score(log_gains.detach() + times.view(-1, 1, 1))
            times = (times - score / slope.clamp_min(0.1)).clamp(-8.0, 8.0)
        score, slope = self.log_score(log_gains + times.view(-1, 1, 1))
        return (times - score / slope.detach().clamp_min(0.1)) * DECIBELS


class FormulaModel:
    """The same sensitivities as formulas: no stimulus is drawn, no area counted."""

    # The exponent of the sum over channels. Status: choice.
    EXPONENT = 4.0

    def __init__(self, observer: Observer, thresholds: list[Threshold]) -> None:
        # The finest level of the Haar transform responds best at half a cycle a pixel.
        self.thresholds = thresholds
        self.views = views(observer, thresholds, np.array([2.0 * t.scale for t in thresholds]))

    def residual(self, free: dict[str, Tensor]) -> Tensor:
        """Return predicted over human threshold in dB, (rows,)."""
        finest = gains(self.views, free)[:, 0]
        seen = (finest**self.EXPONENT).sum(-1) ** (1.0 / self.EXPONENT)
        return -torch.log(seen) * DECIBELS


def groups(thresholds: list[Threshold]) -> NDArray[np.int64]:
    """Return a number for each study and mechanism, (rows,)."""
    names = [f"{t.study}|{t.mechanism}" for t in thresholds]
    return np.unique(names, return_inverse=True)[1]


def centred(residual: Array, thresholds: list[Threshold]) -> Array:
    """Return residuals less the mean of their study and mechanism: one gain each."""
    group = groups(thresholds)
    means = np.bincount(group, residual) / np.bincount(group)
    return residual - means[group]


def by_mechanism(residual: Array, thresholds: list[Threshold]) -> dict[str, float]:
    """Return the rms of every mechanism."""
    mechanism = np.array([t.mechanism for t in thresholds])
    return {
        name: float(np.sqrt(np.mean(residual[mechanism == name] ** 2)))
        for name in MECHANISMS
        if (mechanism == name).any()
    }


def robust(residual: Tensor) -> Tensor:
    """Return residuals in dB that count less from `OUTLIER` on: squared, they rise linearly.

    The soft L1 loss, of the thresholds alone: beliefs and anchors are no outliers.
    """
    return residual * torch.sqrt(2.0 / (1.0 + torch.sqrt(1.0 + (residual / OUTLIER) ** 2)))


def fit(
    model: Model | FormulaModel,
    start: dict[str, float],
    evaluations: int = 25,
    spread: float = SPREAD,
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fitted parameters and the standard deviation of their logarithms.

    ``spread`` is the rms of the data in dB: how much the beliefs of `FREE` weigh against it.
    """
    from scipy.optimize import least_squares

    thresholds = model.thresholds
    group = torch.tensor(groups(thresholds))
    count = int(group.max()) + 1
    share = nn.functional.one_hot(group, count).double()
    mean_of = share / share.sum(0)
    mixed = torch.tensor([t.mechanism == "mixed" for t in thresholds])
    weight = torch.where(mixed, MIXED_WEIGHT**0.5, 1.0).double()
    mechanisms = sorted({t.mechanism for t in thresholds} - {"mixed"})
    anchors = torch.stack(
        [share[[t.mechanism == name for t in thresholds]].amax(0) for name in mechanisms]
    )
    names = list(FREE)
    centre = torch.tensor([math.log(FREE[name][0]) for name in names])
    width = torch.tensor([FREE[name][1] for name in names]).double()

    def terms(logs: Tensor) -> Tensor:
        free = {name: torch.exp(value) for name, value in zip(names, logs, strict=True)}
        residual = model.residual(free)
        means = mean_of.T @ residual
        within = robust(residual - share @ means) * weight
        held = ANCHOR**0.5 * (anchors @ means) / anchors.sum(1)
        return torch.cat((within, held, spread * (logs - centre) / width))

    def evaluate(logs: Array) -> Array:
        with torch.no_grad():
            return np.asarray(terms(torch.tensor(logs)))

    def slopes(logs: Array) -> Array:
        return np.asarray(jacfwd(terms)(torch.tensor(logs)).detach())

    found = least_squares(
        evaluate,
        np.log([start[name] for name in names]),
        jac=slopes,
        max_nfev=evaluations,
        xtol=1e-4,
        ftol=1e-5,
    )
    covariance = np.linalg.inv(found.jac.T @ found.jac) * np.mean(found.fun**2)
    values = {name: float(np.exp(value)) for name, value in zip(names, found.x, strict=True)}
    return values, dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))


def predicted(model: Model | FormulaModel, values: dict[str, float]) -> Array:
    """Return the residuals of a model in dB."""
    with torch.no_grad():
        free = {name: torch.tensor(value).double() for name, value in values.items()}
        return np.asarray(model.residual(free))


def five_folds(thresholds: list[Threshold]) -> NDArray[np.int64]:
    """Return a fold for each row, grouped by study, condition and luminance."""
    keys = [f"{t.study}|{t.condition}|{t.luminance}" for t in thresholds]
    return np.array([int(hashlib.sha256(k.encode()).hexdigest(), 16) % 5 for k in keys])


def studies(thresholds: list[Threshold]) -> NDArray[np.int64]:
    """Return a fold for each study; -1 where it is too small to be left out."""
    names = [t.study.removesuffix("_disc") for t in thresholds]
    unique = sorted(set(names) - {"wright1983"})
    return np.array([unique.index(n) if n in unique else -1 for n in names])


def left_out(
    make: Any, thresholds: list[Threshold], folds: NDArray[np.int64], start: dict[str, float]
) -> dict[str, float]:
    """Return the rms of rows that the fit did not see, one gain a study and mechanism."""
    residual = np.full(len(thresholds), np.nan)
    for fold in sorted(set(folds.tolist()) - {-1}):
        inside = [t for t, f in zip(thresholds, folds, strict=True) if f != fold]
        outside = [t for t, f in zip(thresholds, folds, strict=True) if f == fold]
        values, _ = fit(make(inside), start)
        residual[folds == fold] = predicted(make(outside), values)
    seen = folds >= 0
    some = [t for t, s in zip(thresholds, seen, strict=True) if s]
    return by_mechanism(centred(residual[seen], some), some)


def whole_metric(
    observer: Observer,
    thresholds: list[Threshold],
    expected: Array,
    cycle: float,
    phase: float,
    **options: Any,
) -> Array:
    """Return predicted over human threshold in dB by `VDM.score` on rendered light, (rows,).

    By bisection within 8 dB of ``expected``, to 0.25 dB.
    """
    residual = []
    metrics: dict[float, VDM] = {}
    for threshold, about in zip(thresholds, expected, strict=True):
        ppd = sampling(threshold, cycle)
        if ppd not in metrics:
            metrics[ppd] = VDM(ppd, Display.xyz(), observer, **options)
        drawn = pattern(threshold, ppd, phase)
        flat = render(threshold, drawn, 0.0).float()
        low, high = about - 8.0, about + 8.0
        for _ in range(6):
            middle = 0.5 * (low + high)
            stimulus = render(threshold, drawn, 10.0 ** (middle / 20.0)).float()
            seen = float(metrics[ppd].score(stimulus, flat)) > 1.0
            low, high = (low, middle) if seen else (middle, high)
        residual.append(0.5 * (low + high))
    return np.array(residual)


def masking(observer: Observer, pedestals: tuple[float, ...]) -> dict[str, Any]:
    """Return how a Gabor patch is hidden by its own pedestal, both in dB over its threshold.

    2 cycles/degree, 50 cd/m2; by `VDM.score` and bisection. The slope is that of the last two.
    """
    patch = Threshold(0, "", "", "", 2.0, 3.14, 0.5, 50.0, (0.01,) * 3, "gabor", 0.0)
    ppd = 32.0
    drawn, metric = pattern(patch, ppd, 0.4), VDM(ppd, Display.xyz(), observer)

    def increment(pedestal: float) -> float:
        below = render(patch, drawn, pedestal)
        low, high = -30.0, 40.0
        for _ in range(12):
            middle = 0.5 * (low + high)
            above = render(patch, drawn, pedestal + 10.0 ** (middle / 20.0))
            seen = float(metric.score(above, below)) > 1.0
            low, high = (low, middle) if seen else (middle, high)
        return 0.5 * (low + high)

    threshold = increment(0.0)
    found = [increment(10.0 ** ((threshold + p) / 20.0)) - threshold for p in pedestals]
    slope = (found[-1] - found[-2]) / (pedestals[-1] - pedestals[-2])
    return {
        "pedestal_db": list(pedestals),
        "increment_db": found,
        "lowest_db": min(found),
        "slope": slope,
    }


def run(quick: bool, output: Path | None) -> None:
    torch.set_default_dtype(torch.float64)
    try:
        result = {**record.circumstances(), **calibrate(quick)}
    finally:
        torch.set_default_dtype(torch.float32)
    text = table(result)
    print(text)
    if output is not None:
        record.save(output, "calibrate", result, text)


def calibrate(quick: bool) -> dict[str, Any]:
    rows = read_thresholds()
    bright = [max(map(abs, t.contrast)) > HIGHEST_CONTRAST for t in rows]
    discs = [t for t, b in zip(rows, bright, strict=True) if t.stimulus == "disk" and not b]
    used = [t for t, b in zip(rows, bright, strict=True) if t.stimulus != "disk" and not b]
    if quick:
        used, discs = used[::8], discs[::5]
    observer = Observer.calibrated()
    drawings = DRAWINGS[:1] if quick else DRAWINGS
    start = {name: value for name, (value, _) in FREE.items()}

    def drawn(some: list[Threshold]) -> Model:
        return Model(observer, some, drawings[:1])

    def formula(some: list[Threshold]) -> FormulaModel:
        return FormulaModel(observer, some)

    values, deviations = fit(Model(observer, used, drawings), start, 6 if quick else 50)
    residual = predicted(Model(observer, used, drawings), values)
    discs_residual = predicted(Model(observer, discs, drawings), values)
    numbers: dict[str, Any] = {**values}
    fitted = dataclasses.replace(observer, **numbers)
    result: dict[str, Any] = {
        "parameters": {
            name: {"value": values[name], "times_or_over": math.exp(deviations[name])}
            for name in FREE
        },
        "in_sample": by_mechanism(centred(residual, used), used),
        "without_gains": by_mechanism(residual, used),
        "discs": by_mechanism(discs_residual, discs),
        "discs_with_gains": by_mechanism(centred(discs_residual, discs), discs),
        "excluded_rows": [t.row for t, b in zip(rows, bright, strict=True) if b],
        "gains": study_gains(residual, used),
    }
    if not quick:
        one, _ = fit(drawn(used), values)
        result["one_drawing"] = by_mechanism(centred(predicted(drawn(used), one), used), used)
        result["five_folds"] = left_out(drawn, used, five_folds(used), values)
        result["leave_one_study_out"] = left_out(drawn, used, studies(used), start)
        formula_values, _ = fit(formula(used), start)
        result["formula_in_sample"] = by_mechanism(
            centred(predicted(formula(used), formula_values), used), used
        )
        result["formula_leave_one_study_out"] = left_out(formula, used, studies(used), start)
    pedestals = (0.0, 24.0, 30.0) if quick else (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0, 24.0, 30.0)
    result["masking"] = masking(fitted, pedestals)
    every = 16 if quick else 1
    some = used[::every]
    whole = whole_metric(fitted, some, residual[::every], *DRAWINGS[0])
    result["whole_metric"] = by_mechanism(centred(whole, some), some)
    return result


def study_gains(residual: Array, thresholds: list[Threshold]) -> dict[str, float]:
    """Return the mean residual of every study and mechanism, dB."""
    names = np.array([f"{t.study}, {t.mechanism}" for t in thresholds])
    return {str(name): float(residual[names == name].mean()) for name in np.unique(names)}


ROWS = {
    "in_sample": "in sample",
    "one_drawing": "in sample, one drawing of each stimulus",
    "five_folds": "five folds, one drawing",
    "leave_one_study_out": "one study left out, one drawing",
    "formula_in_sample": "the curves alone, in sample",
    "formula_leave_one_study_out": "the curves alone, one study left out",
    "whole_metric": "`VDM.score` on rendered light, in sample",
    "without_gains": "in sample, without gains of studies",
    "discs": "discs, not fitted, without gains",
    "discs_with_gains": "discs, not fitted",
}


def table(result: dict[str, Any]) -> str:
    lines = [
        "# The calibrated observer, fitted to human thresholds",
        "",
        record.caption(result),
        "",
        "Predicted over human contrast threshold; one gain a study and mechanism unless stated.",
        "",
        "| rms, dB | " + " | ".join(MECHANISMS) + " |",
        "|---|" + "---|" * len(MECHANISMS),
    ]
    for key, name in ROWS.items():
        if key in result:
            cells = [f"{result[key][m]:.2f}" if m in result[key] else "" for m in MECHANISMS]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    hidden = result["masking"]
    lines += [
        "",
        "A Gabor patch on its own pedestal: far above threshold its increment rises with a slope "
        f"of {hidden['slope']:.2f}; at its lowest it is {hidden['lowest_db']:+.1f} dB. In dB over "
        "threshold, at a pedestal in dB over threshold: "
        + ", ".join(
            f"{found:+.1f} at {pedestal:+.0f}"
            for pedestal, found in zip(hidden["pedestal_db"], hidden["increment_db"], strict=True)
        )
        + ".",
        "",
        "Mean over threshold in dB: "
        + "; ".join(f"{name} {gain:+.1f}" for name, gain in result["gains"].items())
        + f". Left out for their contrast: rows {', '.join(map(str, result['excluded_rows']))}.",
    ]
    lines += ["", "| parameter | value | within a factor of |", "|---|---|---|"]
    lines += [
        f"| {name} | {found['value']:.4g} | {found['times_or_over']:.2f} |"
        for name, found in result["parameters"].items()
    ]
    return "\n".join(lines) + "\n"
