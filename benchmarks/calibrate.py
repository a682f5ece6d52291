"""The calibrated observer, fitted to people by running the metric on their stimuli, rung by rung.

At threshold the largest value of the map is to be 1. Every stimulus is drawn and decomposed; as
long as its contrast leaves the eye's adaptation as it is, a coefficient's weighted contrast is a
number of its level, its channel and its luminance alone times the coefficient at a contrast of 1.
`VDM.respond` gives that number for a coefficient of 1, and the coefficients at the place where the
map is largest stand for the stimulus, so that a fit takes seconds. The zones of a rendered picture
in which people could not see its noise any more are fitted too, by the whole metric. What comes out
is judged by `VDM.score` itself, on the stimuli as light.

A rung could also be held to what `reference` says of pictures. What that would gain, and cost of
people's thresholds, is measured for the two rungs below it, and not used.
"""

import dataclasses
import hashlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.func import functional_call, jacfwd
from torch.nn import functional

from benchmarks import pictures, record
from benchmarks.people import DECIBELS, PPD, PPDS, zone_scores, zones
from benchmarks.pictures import Pair
from benchmarks.rungs import ALL, RUNGS
from benchmarks.thresholds import (
    Threshold,
    background,
    pattern,
    read_thresholds,
    render,
    sampling,
)
from torch_vdm import VDM, Display, Effects, Observer
from torch_vdm.model.cortex import Cortex, Transform, bands
from torch_vdm.model.filtering import band_contrast, band_sensitivity
from torch_vdm.model.masking import unmasked
from torch_vdm.model.pooling import covering, phase_energy, pool_halves
from torch_vdm.model.quadtree import push, surround

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

# How strongly the mean of a mechanism's studies is held to 0, and that of a picture's noise,
# against one row. Status: choice: less of the first lets the fit trade a mechanism's absolute
# sensitivity, which is what 1 JND means, for the shape of another; the second divides between
# gratings and noise what no observer of these parameters has of both.
ANCHOR, NOISE = 90.0, 300.0

# Where a rung is held to `reference`: how strongly all pictures together are, against one row; of
# how many photographs the distortions are fitted, and the share of the renders. The others judge.
# Status: choice.
LIKENESS, FITTED_PHOTOS, FITTED_RENDERS = 2000.0, 2, 2.0 / 3.0

# The step of a parameter's logarithm for the slopes of what the whole metric says.
STEP = 0.1

# Evaluations of a fit that begins near where it ends.
IN_FOLDS = 10

# Every so many zones are fitted, and of these every so many in a fold; all are judged.
ZONES = 2

# Levels that are looked at, from the finest.
LEVELS = 9

Array = NDArray[np.float64]


class _Responses(nn.Module):
    """What weights coefficients, as a module, so that its constants can be replaced."""

    def __init__(self, observer: Observer, ppd: float, transform: Transform) -> None:
        super().__init__()
        effects = Effects(masking=False, pooling=False)
        self.metric = VDM(ppd, Display.xyz(), observer, transform, effects)

    def forward(self, light: Tensor, contrast: Tensor) -> Tensor:
        """Return the weighted contrast of a coefficient of 1, of ``contrast`` on ``light``.

        Both (rows, 3). On a level, the finest first, (rows, levels, channels, gains of a level); or
        in a band, behind a filter, (rows, bands, channels, 1), before a level's gain.
        """
        plane = light[:, :, None, None]
        detail = plane * contrast[:, :, None, None]
        if self.metric.transform.csf == "filter":
            return self._of_bands(plane, detail)
        each = detail.unsqueeze(2).expand(-1, -1, len(self.metric.transform.peaks(0)), -1, -1)
        cortex = Cortex((each,) * LEVELS, (plane,) * LEVELS, plane)
        return torch.stack([r[..., 0, 0] for r in reversed(self.metric.respond(cortex))], 1)

    def _of_bands(self, plane: Tensor, detail: Tensor) -> Tensor:
        model = self.metric.model(detail.dtype)
        passed, weights, table = model.band_weights()
        assert table is not None
        constants = dict(model.constants)
        eye = constants["dark_cones"], constants["opponents"]
        found = []
        for band in range(LEVELS + 1):
            some = slice(band, band + 1)
            at_places = band_sensitivity(plane, torch.cat((table[some], table[-1:])), constants)
            weighing = passed[some], weights[:, some], at_places
            found.append(band_contrast(plane, (detail,), *weighing, *eye)[..., 0])
        return torch.stack(found, 1)


class _View(NamedTuple):
    """The thresholds that are drawn at one sampling."""

    rows: list[int]
    """Their numbers."""
    responses: _Responses
    light: Tensor
    """(rows, 3): their background, S, M, L."""
    contrast: Tensor
    """(rows, 3): theirs."""


def views(
    observer: Observer,
    thresholds: list[Threshold],
    ppds: Array,
    transform: Transform = RUNGS["fast"],
) -> list[_View]:
    """Group thresholds by the pixels per degree at which they are drawn."""
    groups = defaultdict(list)
    for row, ppd in enumerate(ppds):
        groups[float(ppd)].append(row)
    found = []
    for ppd, rows in groups.items():
        light = torch.stack([background(thresholds[row].luminance) for row in rows])
        contrast = torch.stack([torch.tensor(thresholds[row].contrast).double() for row in rows])
        found.append(_View(rows, _Responses(observer, ppd, transform), light, contrast))
    return found


def gains(of: list[_View], free: dict[str, Tensor]) -> Tensor:
    """Return what `_Responses` does at the thresholds' contrast, for all rows."""
    constants = {f"metric.{name}": value for name, value in free.items()}
    found: dict[int, Tensor] = {}
    for view in of:
        weighted = functional_call(view.responses, constants, (view.light, view.contrast))
        found |= zip(view.rows, weighted, strict=True)
    return torch.stack([found[row] for row in range(len(found))])


class _Coefficients:
    """The coefficients of drawn stimuli at the place where their map is largest."""

    def __init__(self, transform: Transform, exponent: Tensor, power: float) -> None:
        self.transform, self.exponent, self.power = transform, exponent, power
        # What is pooled at a place lies so many nodes before and after it.
        self.sides = (3, 2, 3, 2) if transform.shifts > 1 else (1, 1, 1, 1)

    def decomposed(self, drawn: Tensor) -> list[Tensor]:
        """Return the levels (1, bands or 1, orientations, h, w) of (H, W), the finest first."""
        planes = drawn[None, None]
        if self.transform.csf == "filter":
            planes = torch.cat(_bands(planes), 1)[:, : LEVELS + 1]
        self.cortex = self.transform.decompose(planes, true_means=True)
        details = self.cortex.details[-LEVELS:][::-1]
        if self.transform.csf == "levels":
            return list(details)
        level_gains = [[gain for _, gain in self.transform.peaks(k)] for k in range(len(details))]
        return [
            detail / detail.new_tensor(gain)[:, None, None]
            for detail, gain in zip(details, level_gains, strict=True)
        ]

    def pooled(self, weighted: Tensor) -> Tensor:
        """Return the energy (B, C, orientations, h, w) of contrasts, pooled and masked."""
        energy = phase_energy(weighted, self.transform.phases)
        planes = torch.cat((energy, (weighted * weighted).sum(2, keepdim=True)), 2)
        if self.transform.shifts > 1:
            around = surround(planes, 3, 2)
            pooled = pool_halves(pool_halves(around, 3, -1), 3, -2) / covering(3)
        else:
            around = functional.pad(planes, (*self.sides, 0, 0), mode="replicate")
            pooled = functional.avg_pool3d(around, (1, 3, 3), 1)
        return pooled[:, :, :-1] * torch.exp2(unmasked(pooled[:, :, -1:], self.exponent))

    def at_largest(self, details: list[Tensor], gain: Tensor) -> list[Tensor]:
        """Return what the largest place of the map pools, (bands or 1, orientations, n, n) a level.

        ``gain``: of one row of `gains`.
        """
        # As one channel: of the largest gain.
        gain = gain.gather(
            1, gain.abs().sum((0, 2)).argmax().view(1, 1, 1).expand(len(gain), 1, gain.shape[2])
        )
        total = torch.zeros(1, 1, 1, 1)
        places: list[Tensor] = []
        for level in reversed(range(len(details))):
            detail = details[level]
            if self.transform.csf == "filter":
                weighted = (detail * gain[: detail.shape[1], 0, 0].view(1, -1, 1, 1, 1)).sum(
                    1, True
                )
            else:
                weighted = detail * gain[level, 0].view(1, 1, -1, 1, 1)
            nodes = (self.pooled(weighted) ** (0.5 * self.power)).sum((1, 2)).unsqueeze(1)
            size = (nodes.shape[-2], nodes.shape[-1])
            before = self.cortex.grid.before(level + 1)
            total = nodes + push(total, size, before=before)
            here = torch.arange(nodes.numel(), dtype=nodes.dtype).view_as(nodes)
            places = [push(place, size, before=before) for place in places] + [here]
        leaf = int(total.argmax())
        found = []
        for detail, place in zip(details, reversed(places), strict=True):
            y, x = divmod(int(place.flatten()[leaf]), detail.shape[-1])
            around = functional.pad(detail[0], self.sides, mode="replicate")
            side = 1 + self.sides[0] + self.sides[1]
            found.append(around[..., y : y + side, x : x + side])
        return found


def _bands(plane: Tensor) -> list[Tensor]:
    """Return the bands of (1, 1, H, W), the finest first, each at its size."""
    scales: list[bands.Scale] = []
    here = plane
    while max(here.shape[-2:]) > 1:
        scales.append(bands.parted(here, not scales))
        here = scales[-1].lowpass
    found = []
    for number, scale in enumerate(scales):
        for band in scale.bands:
            finer = [torch.zeros_like(s.around) for s in scales[:number]]
            found.append(bands.gathered([*finer, band]))
    return found


class Model:
    """Predicts the thresholds of a list of rows from the free parameters."""

    def __init__(
        self,
        observer: Observer,
        thresholds: list[Threshold],
        drawings: tuple[tuple[float, float], ...],
        transform: Transform = RUNGS["fast"],
    ) -> None:
        self.observer, self.thresholds, self.transform = observer, thresholds, transform
        self.exponent = torch.tensor(observer.transducer_exponent).double()
        self.views = [
            views(observer, thresholds, np.array([sampling(t, c) for t in thresholds]), transform)
            for c, _ in drawings
        ]
        # The power of a level's largest response, as a table over the logarithm of its gain.
        self.start, self.step = -12.0, 0.1
        self.grid = torch.arange(self.start, 14.0, self.step, dtype=torch.float64)
        keys = [(t.frequency, t.area, t.sigma, t.stimulus, t.orientation) for t in thresholds]
        first = {key: row for row, key in reversed(list(enumerate(keys)))}
        self.pattern_of = torch.tensor([list(first).index(key) for key in keys])
        free = {name: torch.tensor(getattr(observer, name)).double() for name in FREE}
        self.tables = []
        for of, (cycle, phase) in zip(self.views, drawings, strict=True):
            with torch.no_grad():
                gain = gains(of, free)
                rows = [
                    self._table(thresholds[row], cycle, phase, gain[row]) for row in first.values()
                ]
            self.tables.append(torch.stack(rows))

    def _table(self, threshold: Threshold, cycle: float, phase: float, gain: Tensor) -> Tensor:
        """Return what stands for a drawn stimulus.

        The logarithm of the power (levels, gains of a level, grid); or behind a filter, where
        levels are made of bands, the coefficients themselves (levels, bands, orientations, n).
        """
        of = _Coefficients(self.transform, self.exponent, self.observer.summation_exponent)
        details = of.decomposed(pattern(threshold, sampling(threshold, cycle), phase))
        found = of.at_largest(details, gain)
        if self.transform.csf == "filter":
            whole = torch.zeros(LEVELS, LEVELS + 1, *found[0].flatten(-2).shape[1:])
            for level, part in enumerate(found):
                whole[level, : len(part)] = part.flatten(-2)
            return whole.float()
        kinds = len(self.transform.peaks(0))
        table = torch.zeros(LEVELS, kinds, len(self.grid), dtype=torch.float64)
        for level, part in enumerate(found):
            contrast = torch.exp(self.grid).view(-1, 1, 1, 1) * part.flatten(-2)
            power = self._power(contrast.unsqueeze(-2)).squeeze(1)
            table[level] = (power.sum(1, keepdim=True) if kinds == 1 else power).T
        return torch.log(table + 1e-300)

    def _power(self, contrast: Tensor) -> Tensor:
        """Return the power (..., orientations) of contrasts (B, ., orientations, 1, nodes)."""
        energy = phase_energy(contrast, self.transform.phases).mean((-2, -1))
        masks = (contrast * contrast).sum(2, keepdim=True).mean((-2, -1))
        left = energy * torch.exp2(unmasked(masks, self.exponent))
        return left ** (0.5 * self.observer.summation_exponent)

    def log_score(self, gain: list[Tensor], times: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logarithm of the score, mean over the drawings, and its slope; (rows,)."""
        of = self._filtered_score if self.transform.csf == "filter" else self._level_score
        found = [of(g, table, times) for g, table in zip(gain, self.tables, strict=True)]
        score, slope = (torch.stack(part).mean(0) for part in zip(*found, strict=True))
        return score / self.observer.summation_exponent, slope / self.observer.summation_exponent

    def _level_score(self, gain: Tensor, table: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        logs = torch.log(gain.abs().clamp_min(1e-12)) + times.view(-1, 1, 1, 1)
        table = table[self.pattern_of]
        place = ((logs.transpose(2, 3) - self.start) / self.step).clamp(
            0.0, table.shape[-1] - 1.001
        )
        low = place.detach().floor().long()
        below = table.gather(-1, low)
        rise = table.gather(-1, low + 1) - below
        terms = (below + rise * (place - low)).flatten(1)
        slope = (torch.softmax(terms, -1) * rise.flatten(1) / self.step).sum(-1)
        return torch.logsumexp(terms, -1), slope.detach()

    def _filtered_score(self, gain: Tensor, table: Tensor, times: Tensor) -> tuple[Tensor, Tensor]:
        weights = (gain[..., 0] * torch.exp(times).view(-1, 1, 1)).to(table)
        contrast = torch.einsum("rlbon,rbc->rclon", table[self.pattern_of], weights)
        half = 0.5 * self.observer.summation_exponent
        energy = (contrast * contrast).mean(-1)
        masks = energy.sum(3, keepdim=True)
        exponent = self.exponent.to(table)
        power = (energy * torch.exp2(unmasked(masks, exponent))) ** half
        # Of the logarithm of the power by that of the contrast.
        rise = 2.0 * half * (1.0 - 2.0 * exponent * masks / (1.0 + masks))
        total = power.sum((1, 2, 3)).double().clamp_min(1e-300)
        slope = (power * rise).sum((1, 2, 3)).double() / total
        return torch.log(total), slope.detach()

    def residual(self, free: dict[str, Tensor]) -> Tensor:
        """Return predicted over human threshold in dB, (rows,)."""
        gain = [gains(of, free) for of in self.views]
        fixed = [g.detach() for g in gain]
        times = torch.zeros(len(self.thresholds), dtype=torch.float64)
        # Newton on the logarithm of contrast; the last step carries the derivative.
        for _ in range(8):
            score, slope = self.log_score(fixed, times)
            times = (times - (score / slope.clamp_min(0.1)).detach()).clamp(-8.0, 8.0)
        score, slope = self.log_score(gain, times)
        return (times - score / slope.clamp_min(0.1)) * DECIBELS


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
        finest = gains(self.views, free)[:, 0, :, 0].abs()
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


# What the whole metric says of pictures, by logarithms of the parameters: weighted residuals in dB.
Seen = Callable[[Array], Array]


def _nothing_seen(logs: Array) -> Array:
    del logs
    return np.zeros(0)


def fit(
    model: Model | FormulaModel,
    start: dict[str, float],
    evaluations: int = 25,
    spread: float = SPREAD,
    seen: Seen = _nothing_seen,
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the fitted parameters and the standard deviation of their logarithms.

    ``spread`` is the rms of the data in dB: how much the beliefs of `FREE` weigh against it. What
    is ``seen`` of pictures is fitted beside the thresholds.
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
            return np.append(terms(torch.tensor(logs)), seen(logs))

    def slopes(logs: Array) -> Array:
        rows = jacfwd(terms)(torch.tensor(logs)).detach()
        return np.vstack((rows, _slopes(seen, logs)))

    begin = np.log([start[name] for name in names])
    found = least_squares(evaluate, begin, jac=slopes, max_nfev=evaluations, xtol=1e-4, ftol=1e-5)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * np.mean(found.fun**2)
    return _values(found.x), dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True))


def _slopes(seen: Seen, about: Array) -> Array:
    """Return the slopes of what is seen by the parameters' logarithms."""
    here = seen(about)
    rises = [seen(about + step) - here for step in STEP * np.eye(len(about))]
    return np.stack(rises, 1) / STEP


def noise_of(observer: Observer, transform: Transform, every: int = ZONES) -> Seen:
    """Return what is seen of the noise in SIN3D's zones: its mean; nothing without the data."""
    some = zones()[::every]
    if not some:
        return _nothing_seen

    def noise(logs: Array) -> Array:
        scores = zone_scores(_changed(observer, _values(logs)), transform, PPD, some)
        return np.array([NOISE**0.5 * np.mean(DECIBELS * np.log(scores))])

    return noise


def likeness_of(observer: Observer, transform: Transform, some: list[Pair], aim: Array) -> Seen:
    """Return what is seen of pairs, over what `reference` sees: its largest values, ``aim``."""

    def likeness(logs: Array) -> Array:
        found = pictures.largest(_changed(observer, _values(logs)), transform, some)
        weighted: Array = (LIKENESS / len(some)) ** 0.5 * DECIBELS * np.log(found / aim)
        return weighted

    return likeness


def _values(logs: Array) -> dict[str, float]:
    """Return the parameters from their logarithms."""
    return dict(zip(FREE, np.exp(logs).tolist(), strict=True))


def _changed(observer: Observer, values: dict[str, Any]) -> Observer:
    return dataclasses.replace(observer, **values)


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
    make: Any,
    thresholds: list[Threshold],
    folds: NDArray[np.int64],
    start: dict[str, float],
    seen: Seen = _nothing_seen,
) -> dict[str, float]:
    """Return the rms of rows that the fit did not see, one gain a study and mechanism."""
    residual = np.full(len(thresholds), np.nan)
    for fold in sorted(set(folds.tolist()) - {-1}):
        inside = [t for t, f in zip(thresholds, folds, strict=True) if f != fold]
        outside = [t for t, f in zip(thresholds, folds, strict=True) if f == fold]
        values, _ = fit(make(inside), start, IN_FOLDS, seen=seen)
        residual[folds == fold] = predicted(make(outside), values)
    left = folds >= 0
    some = [t for t, one in zip(thresholds, left, strict=True) if one]
    return by_mechanism(centred(residual[left], some), some)


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


def masking(
    observer: Observer, transform: Transform, pedestals: tuple[float, ...]
) -> dict[str, Any]:
    """Return how a Gabor patch is hidden by its own pedestal, both in dB over its threshold.

    2 cycles/degree, 50 cd/m2; by `VDM.score` and bisection. The slope is that of the last two.
    """
    patch = Threshold(0, "", "", "", 2.0, 3.14, 0.5, 50.0, (0.01,) * 3, "gabor", 0.0)
    ppd = 32.0
    drawn, metric = pattern(patch, ppd, 0.4), VDM(ppd, Display.xyz(), observer, transform)

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
        result = record.circumstances()
        # What is done is kept.
        for found in calibrate(quick):
            result |= found
            if output is not None:
                record.save(output, "calibrate", result, table(result))
    finally:
        torch.set_default_dtype(torch.float32)
    print(table(result))


def calibrate(quick: bool) -> Iterator[dict[str, Any]]:
    """Yield what is found, rung by rung."""
    rows = read_thresholds()
    bright = [max(map(abs, t.contrast)) > HIGHEST_CONTRAST for t in rows]
    discs = [t for t, b in zip(rows, bright, strict=True) if t.stimulus == "disk" and not b]
    used = [t for t, b in zip(rows, bright, strict=True) if t.stimulus != "disk" and not b]
    if quick:
        used, discs = used[::8], discs[::5]
    found: dict[str, Any] = {
        "excluded_rows": [t.row for t, b in zip(rows, bright, strict=True) if b],
        "noise_is_fitted": bool(zones()) and not quick,
        "rungs": {},
    }
    rungs = {n: t for n, t in ALL.items() if not quick or n in ("fast", "standard")}
    with ProcessPoolExecutor(initializer=_alone, mp_context=get_context("spawn")) as pool:
        # The slowest, which are the last, first.
        jobs = {
            pool.submit(rung, rungs[name], used, discs, quick): name for name in reversed(rungs)
        }
        for job in as_completed(jobs):
            done = found["rungs"] | {jobs[job]: job.result()}
            found["rungs"] = {name: done[name] for name in rungs if name in done}
            yield found
    if not quick and pictures.photographs(1):
        aims = beside_reference()
        for name in ("fast", "standard"):
            found["rungs"][name]["held_to_reference"] = held(
                RUNGS[name], used, found["rungs"][name], *aims
            )
            yield found
    if not quick:
        # The curves alone, of the rung that has the paper's transform.
        observer, start = Observer.calibrated(), {n: value for n, (value, _) in FREE.items()}

        def formula(some: list[Threshold]) -> FormulaModel:
            return FormulaModel(observer, some)

        values, _ = fit(formula(used), start)
        residual = predicted(formula(used), values)
        found["formula_in_sample"] = by_mechanism(centred(residual, used), used)
        found["formula_leave_one_study_out"] = left_out(formula, used, studies(used), start)
        yield found


def _alone() -> None:
    """Set up a process that is one of as many as there are cores."""
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)


def rung(
    transform: Transform, used: list[Threshold], discs: list[Threshold], quick: bool
) -> dict[str, Any]:
    """Return what the fit of one rung gives."""
    observer = Observer.calibrated().fitted_to(transform)
    # Behind a filter a drawing costs ten times as much.
    drawings = DRAWINGS[:1] if quick or transform.csf == "filter" else DRAWINGS
    start = {name: getattr(observer, name) for name in FREE}

    def drawn(some: list[Threshold]) -> Model:
        return Model(observer, some, DRAWINGS[:1], transform)

    noise = _nothing_seen if quick else noise_of(observer, transform)
    model = Model(observer, used, drawings, transform)
    values, deviations = fit(model, start, 6 if quick else 30, seen=noise)
    residual = predicted(model, values)
    discs_residual = predicted(Model(observer, discs, drawings, transform), values)
    fitted = _changed(observer, values)
    result: dict[str, Any] = {
        "parameters": {
            name: {"value": values[name], "times_or_over": math.exp(deviations[name])}
            for name in FREE
        },
        "in_sample": by_mechanism(centred(residual, used), used),
        "without_gains": by_mechanism(residual, used),
        "without_gains_together": float(np.sqrt(np.mean(residual**2))),
        "discs": by_mechanism(discs_residual, discs),
        "discs_with_gains": by_mechanism(centred(discs_residual, discs), discs),
        "gains": study_gains(residual, used),
    }
    if not quick:
        noise = noise_of(observer, transform, ZONES * ZONES)
        one, _ = fit(drawn(used), values, IN_FOLDS, seen=noise)
        result["one_drawing"] = by_mechanism(centred(predicted(drawn(used), one), used), used)
        folds = five_folds(used), studies(used)
        result["five_folds"] = left_out(drawn, used, folds[0], values, noise)
        result["leave_one_study_out"] = left_out(drawn, used, folds[1], values, noise)
        result["zones"] = {
            str(ppd): zone_scores(fitted, transform, ppd, zones()).tolist() for ppd in PPDS
        }
    pedestals = (0.0, 24.0, 30.0) if quick else (-12.0, -6.0, -3.0, 0.0, 3.0, 6.0, 12.0, 24.0, 30.0)
    result["masking"] = masking(fitted, transform, pedestals)
    every = 16 if quick else 4
    some = used[::every]
    whole = whole_metric(fitted, some, residual[::every], *DRAWINGS[0], transform=transform)
    result["whole_metric"] = by_mechanism(centred(whole, some), some)
    return result


class _Beside(NamedTuple):
    """Pairs, and the largest value of each map of `reference`, JND."""

    pairs: list[Pair]
    aim: Array


def beside_reference() -> tuple[_Beside, _Beside]:
    """Return the pairs that are fitted, and those that judge."""
    photos = list(pictures.of_photographs(pictures.PHOTOGRAPHS))
    renders = list(pictures.renders())
    cut = round(FITTED_RENDERS * len(renders))
    sides = (
        [*chain(*photos[:FITTED_PHOTOS]), *renders[:cut]],
        [*chain(*photos[FITTED_PHOTOS:]), *renders[cut:]],
    )
    fitted, judging = (
        _Beside(some, pictures.largest(None, RUNGS[pictures.JUDGE], some)) for some in sides
    )
    return fitted, judging


def held(
    transform: Transform,
    used: list[Threshold],
    alone: dict[str, Any],
    fitted: _Beside,
    judging: _Beside,
) -> dict[str, Any]:
    """Return what a rung gains and loses when it is held to `reference` on pictures too.

    ``alone``: what `rung` found without.
    """
    observer = Observer.calibrated().fitted_to(transform)
    model = Model(observer, used, DRAWINGS[:1], transform)
    start = {name: alone["parameters"][name]["value"] for name in FREE}
    noise = noise_of(observer, transform, ZONES * ZONES)
    likeness = likeness_of(observer, transform, *fitted)
    values, _ = fit(
        model, start, IN_FOLDS, seen=lambda logs: np.append(noise(logs), likeness(logs))
    )
    told = {}
    for name, parameters in (("alone", start), ("held", values)):
        residual = predicted(model, parameters)
        changed = _changed(observer, parameters)
        octaves = [
            np.log2(pictures.largest(changed, transform, side.pairs) / side.aim)
            for side in (fitted, judging)
        ]
        told[name] = {
            "thresholds": by_mechanism(centred(residual, used), used),
            "without_gains_together": float(np.sqrt(np.mean(residual**2))),
            "pictures_octaves": [float(np.sqrt(np.mean(each**2))) for each in octaves],
            "zones": zone_scores(changed, transform, PPD, zones()).tolist(),
            "parameters": parameters,
        }
    return told


def study_gains(residual: Array, thresholds: list[Threshold]) -> dict[str, float]:
    """Return the mean residual of every study and mechanism, dB."""
    names = np.array([f"{t.study}, {t.mechanism}" for t in thresholds])
    return {str(name): float(residual[names == name].mean()) for name in np.unique(names)}


ROWS = {
    "in_sample": "in sample",
    "one_drawing": "in sample, one drawing of each stimulus",
    "five_folds": "five folds, one drawing",
    "leave_one_study_out": "one study left out, one drawing",
    "whole_metric": "`VDM.score` on rendered light, in sample, every fourth",
    "without_gains": "in sample, without gains of studies",
    "discs": "discs, not fitted, without gains",
    "discs_with_gains": "discs, not fitted",
}
FORMULA_ROWS = {
    "formula_in_sample": "the curves alone, in sample",
    "formula_leave_one_study_out": "the curves alone, one study left out",
}


def table(result: dict[str, Any]) -> str:
    lines = [
        "# The calibrated observer, fitted to people, for each transform",
        "",
        record.caption(result),
        "",
        "Predicted over human contrast threshold, rms in dB; one gain a study and mechanism unless "
        "stated. " + ("With" if result["noise_is_fitted"] else "Without") + " the noise of SIN3D's "
        f"zones in the fit. Left out for their contrast: rows "
        f"{', '.join(map(str, result['excluded_rows']))}.",
        "",
        "| | | " + " | ".join(MECHANISMS) + " |",
        "|---|---|" + "---|" * len(MECHANISMS),
    ]
    for name, found in result["rungs"].items():
        lines += [_row(name, title, found[key]) for key, title in ROWS.items() if key in found]
    lines += [_row("", t, result[key]) for key, t in FORMULA_ROWS.items() if key in result]
    for name, found in result["rungs"].items():
        lines += ["", f"## {name}: `{ALL[name]!r}`", "", *_of_rung(found)]
    return "\n".join(lines) + "\n"


def _row(rung: str, title: str, rms: dict[str, float]) -> str:
    cells = [f"{rms[m]:.2f}" if m in rms else "" for m in MECHANISMS]
    return f"| {rung} | {title} | " + " | ".join(cells) + " |"


def _of_rung(found: dict[str, Any]) -> list[str]:
    hidden = found["masking"]
    lines = [
        f"All mechanisms together, without gains: {found['without_gains_together']:.2f} dB.",
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
        + "; ".join(f"{name} {gain:+.1f}" for name, gain in found["gains"].items())
        + ".",
    ]
    if "zones" in found:
        lines += [
            "",
            "| SIN3D's zones, pixels per degree | geometric mean, JND | octaves |",
            "|---|---|---|",
        ]
        for ppd, scores in found["zones"].items():
            octaves = np.log2(scores)
            lines.append(
                f"| {float(ppd):.0f} | {2.0 ** octaves.mean():.2f} | {octaves.std():.2f} |"
            )
    if "held_to_reference" in found:
        lines += _of_held(found["held_to_reference"])
    lines += ["", "| parameter | value | within a factor of |", "|---|---|---|"]
    lines += [
        f"| {name} | {of['value']:.4g} | {of['times_or_over']:.2f} |"
        for name, of in found["parameters"].items()
    ]
    return lines


def _of_held(found: dict[str, Any]) -> list[str]:
    """Return the table of what holding a rung to `reference` would do."""
    lines = [
        "",
        "If it were held to `reference` on pictures too (not used):",
        "",
        "| | " + " | ".join(MECHANISMS) + " | without gains, together | largest values over "
        "`reference`'s, pictures of the fit, octaves rms | other pictures | SIN3D's zones, JND |",
        "|---|" + "---|" * (len(MECHANISMS) + 4),
    ]
    for name, of in found.items():
        thresholds = " | ".join(f"{of['thresholds'][m]:.2f}" for m in MECHANISMS)
        inside, outside = of["pictures_octaves"]
        octaves = np.log2(of["zones"])
        lines.append(
            f"| {name} | {thresholds} | {of['without_gains_together']:.2f} | {inside:.2f} "
            f"| {outside:.2f} | {2.0 ** octaves.mean():.2f} ± {octaves.std():.2f} octaves |"
        )
    return lines
