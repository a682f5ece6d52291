"""How the largest visible difference falls with samples and time, for each strategy.

A run goes on in small rounds and is judged after each by the metric, against a reference that it
does not know. Where the curve first crosses a tolerance is what the strategy needs for it, so that
all are compared at equal *true* quality, whatever they predict of themselves.

A strategy is asked for `STEP` of the difference that is predicted, again and again. For half-buffer
each such round is a lower noise threshold, so that its threshold at the crossing is the best that a
user could have chosen for this scene.

Time is processor time: of rendering and statistics, and of decisions, which uniform and half-buffer
are not charged with, for they need no metric.

References and runs are kept in `CACHE`, a run under a hash of all that it depends on, so that an
interrupted benchmark goes on where it was.
"""

import dataclasses
import hashlib
import json
import math
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

import sampling
from benchmarks.places import CACHE
from benchmarks.record import source
from sampling import Sampler, Settings, rounds
from sampling.renderers.mitsuba import MitsubaRenderer, load_mitsuba
from torch_vdm import VDM, Display
from torch_vdm.cli import OBSERVERS
from torch_vdm.io import atomic_path

Plane = NDArray[np.float64]

# Of the code that is loaded, not of what is on the disk later: another one makes other runs.
SOURCE = source()

WHITE = 100.0

# Share of the predicted difference that the next round is asked for. Near threshold the error
# falls nearly as one over the samples: 1.15 of them. Status: choice.
STEP = 0.87

# A round is drawn in parts, each evenly of all that was asked, with a look at the image after each;
# by how much a part multiplies the samples. Status: choice.
GROWTH = 1.25

# A reference is rendered from other seeds than any run. Status: choice.
REFERENCE_SEED = 1_000_000

# Of a reference that is rendered adaptively: share of the tolerance. Status: choice.
REFERENCE_SHARE = 0.25

# It may take so many times as long as a run, and so many times the samples. Status: choice.
REFERENCE_TIMES = 12.0

# Strategies that decide without the metric.
NEED_NO_METRIC = ("uniform", "halfbuffer")


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is rendered, and how it is looked at.

    Attributes
    ----------
    name
        In tables.
    path, parameters
        Of the file, and of ``-D``.
    ppd
        Pixels per degree.
    observer
        Who judges, and leads perceptual sampling: "paper", or "calibrated", who leads `vdm-render`.
    tolerances
        The differences in JND to which every strategy is followed, the largest first.
    equal_spp
        Samples a pixel at which images are compared; None: they are not.
    passes, converging
        Of the reference: how many times the sampler that the scene's file names renders its own
        number of samples a pixel, and parameters for it that change the noise and not the image.
        0: adaptively, by this sampler.
    """

    name: str
    path: Path
    parameters: dict[str, str] = dataclasses.field(default_factory=dict)
    ppd: float = 60.0
    observer: str = "paper"
    tolerances: tuple[float, ...] = (2.0,)
    equal_spp: int | None = None
    passes: int = 0
    converging: dict[str, str] = dataclasses.field(default_factory=dict)


class Limits(NamedTuple):
    """Where a run ends that has not reached its tolerance."""

    spp: float
    seconds: float


class Reference(NamedTuple):
    """The image that runs are judged by."""

    image: Plane
    """(H, W, 3), linear BT.709."""
    error: float
    """Its own largest visible difference, JND: half of what its halves differ by, or predicted."""
    seconds: float


class Run(NamedTuple):
    """One strategy on one scene with one seed."""

    points: list[dict[str, float]]
    """After each round: samples a pixel, true and predicted largest difference, seconds."""
    planes: dict[str, Plane]
    """At equal samples: image (H, W, 3), count (H, W), jnd (H, W); none where not asked for."""


def metric_of(scene: Scene) -> VDM:
    """Return the judge of a scene, by whom perceptual sampling is led too."""
    return VDM(scene.ppd, Display.linear(WHITE), OBSERVERS[scene.observer]())


def difference(metric: VDM, image: Plane, reference: Plane) -> Plane:
    """Return the map of visible differences, (H, W), JND."""
    test, other = (torch.from_numpy(np.moveaxis(p, -1, 0)[None].copy()) for p in (image, reference))
    with torch.no_grad():
        jnd: Plane = metric(test, other)[0, 0].numpy()
    return jnd


def reference_of(scene: Scene, limits: Limits, kept_only: bool = False) -> Reference | None:
    """Return the reference, rendered where it is not kept; or None with ``kept_only``."""
    renderer = MitsubaRenderer(scene.path, {**scene.parameters, **scene.converging})
    named = [renderer.fingerprint, scene.passes, scene.ppd, scene.observer, limits]
    if not scene.passes:
        named.append(scene.tolerances)
    path = CACHE / f"reference-{_hash(named)}.npz"
    if not path.exists() and kept_only:
        return None
    if not path.exists():
        start = time.process_time()
        found = _by_passes(scene) if scene.passes else _adaptively(scene, limits)
        with atomic_path(path) as file, file.open("wb") as open_file:
            np.savez_compressed(
                open_file, image=found[0], error=found[1], seconds=time.process_time() - start
            )
    with np.load(path) as kept:
        return Reference(kept["image"], float(kept["error"]), float(kept["seconds"]))


def _by_passes(scene: Scene) -> tuple[Plane, float]:
    """Render with the sampler that the file names, which may be stratified."""
    mi = load_mitsuba()
    loaded = mi.load_file(os.fspath(scene.path), **scene.parameters, **scene.converging)
    halves: list[Plane] = []
    for half in range(2):
        seeds = range(REFERENCE_SEED + half, REFERENCE_SEED + scene.passes, 2)
        renders = [np.array(mi.render(loaded, seed=seed), np.float64)[..., :3] for seed in seeds]
        halves.append(np.mean(renders, 0))
    error = 0.5 * float(difference(metric_of(scene), halves[0], halves[1]).max())
    return 0.5 * (halves[0] + halves[1]), error


def _adaptively(scene: Scene, limits: Limits) -> tuple[Plane, float]:
    """Render until the sampler predicts `REFERENCE_SHARE` of the smallest tolerance."""
    renderer = MitsubaRenderer(scene.path, scene.parameters, seed=REFERENCE_SEED)
    settings = Settings(tolerance=REFERENCE_SHARE * scene.tolerances[-1])
    sampler = Sampler(renderer.size, metric_of(scene), settings)
    start, predicted = time.process_time(), math.inf
    for report in rounds(sampler, renderer):
        predicted = report.predicted
        over = time.process_time() - start > REFERENCE_TIMES * limits.seconds
        if over or report.spp > REFERENCE_TIMES * limits.spp:
            break
    return sampler.image, predicted


def run_of(
    scene: Scene,
    strategy: str,
    seed: int,
    reference: Reference,
    limits: Limits,
    kept_only: bool = False,
) -> Run | None:
    """Return a run, made where it is not kept; or None with ``kept_only``."""
    renderer = MitsubaRenderer(scene.path, scene.parameters, seed=seed)
    described = dataclasses.asdict(scene) | {"path": renderer.fingerprint, "name": ""}
    named = [described, strategy, seed, limits, STEP, GROWTH, SOURCE, reference.error]
    path = CACHE / f"run-{_hash(named)}.npz"
    if not path.exists() and kept_only:
        return None
    if not path.exists():
        found = _run(scene, strategy, renderer, reference, limits)
        with atomic_path(path) as file, file.open("wb") as open_file:
            np.savez_compressed(
                open_file, allow_pickle=False, points=json.dumps(found.points), **found.planes
            )
    with np.load(path) as kept:
        planes = {name: kept[name] for name in kept.files if name != "points"}
        return Run(json.loads(str(kept["points"])), planes)


def _run(
    scene: Scene, strategy: Any, renderer: MitsubaRenderer, reference: Reference, limits: Limits
) -> Run:
    metric = metric_of(scene)
    settings = Settings(strategy=strategy, tolerance=1e6)
    # Compiled before the clock runs.
    every = np.arange(math.prod(renderer.size))
    for _ in range(2):
        renderer.sample(every, 0 * every, 0 * every + 2)
    sampler = Sampler(renderer.size, metric, settings)
    pixels = math.prod(renderer.size)
    equal = scene.equal_spp * pixels if scene.equal_spp is not None else math.inf
    drawn, render, decide = 0, 0.0, 0.0
    points: list[dict[str, float]] = []
    planes: dict[str, Plane] = {}
    while True:
        start = time.process_time()
        request = sampler.ask()
        seconds = time.process_time() - start
        if request is None:
            # It has what it was asked for; a little more is asked, and decided again.
            sampler = _onwards(sampler, metric)
            continue
        decide += seconds if points else 0.0
        report = sampler.report()
        taken = 0 * request.count
        while (taken < request.count).any():
            # No more than makes a fine curve; and the same for every strategy, for images.
            here = min((GROWTH - 1.0) * drawn if drawn else math.inf, float(request.samples))
            if drawn < equal < drawn + here:
                here = equal - drawn
            share = min((int(taken.sum()) + here) / request.samples, 1.0)
            part = np.maximum(np.ceil(share * request.count).astype(np.int64) - taken, 0)
            render += _told(sampler, renderer, request, taken, part)
            taken, drawn = taken + part, drawn + int(part.sum())
            jnd = difference(metric, sampler.image, reference.image)
            true = float(jnd.max())
            points.append(
                {
                    "spp": drawn / pixels,
                    "true": true,
                    # By the decision before, which is the last that has been made.
                    "predicted_before": report.predicted if report is not None else math.nan,
                    "render_seconds": render,
                    "decision_seconds": decide,
                }
            )
            if drawn >= equal and not planes:
                count = sampler.count.astype(np.float64)
                planes = {"image": sampler.image, "count": count, "jnd": jnd}
            reached = true <= scene.tolerances[-1] and (drawn >= equal or not math.isfinite(equal))
            if reached or drawn / pixels > limits.spp or render + decide > limits.seconds:
                return Run(points, planes)


def _told(
    sampler: Sampler,
    renderer: MitsubaRenderer,
    request: sampling.Request,
    skipped: NDArray[np.int64],
    count: NDArray[np.int64],
) -> float:
    """Draw a part of a request, tell it, and return the seconds."""
    some = count > 0
    if not some.any():
        return 0.0
    start = time.process_time()
    part = sampling.Request(request.pixels[some], (request.first + skipped)[some], count[some])
    for piece in part.parts(2**20):
        sampler.tell(renderer.sample(piece.pixels, piece.first, piece.count))
    return time.process_time() - start


def _onwards(sampler: Sampler, metric: VDM) -> Sampler:
    """Return a sampler that has stopped as one that is to go a little further."""
    state, report = sampler.state(), sampler.report()
    assert report is not None
    state["settings.tolerance"] = STEP * report.predicted
    state["report.stop_reason"] = None
    return Sampler.restore(state, metric)


def needed(points: list[dict[str, float]], tolerance: float, of: str) -> float | None:
    """Return where the true maximum first falls to a tolerance, by the logarithms; None: nowhere.

    Parameters
    ----------
    points
        Of a run.
    tolerance
        JND.
    of
        "spp", or a sum of seconds.
    """
    before = None
    for point in points:
        if point["true"] <= tolerance:
            if before is None or before["true"] <= tolerance:
                return point[of]
            share = math.log(before["true"] / tolerance) / math.log(before["true"] / point["true"])
            return float(before[of] ** (1.0 - share) * point[of] ** share)
        before = point
    return None


def charged(strategy: str, points: list[dict[str, float]]) -> list[dict[str, float]]:
    """Return the points with the ``seconds`` that a strategy is charged with."""
    own = 0.0 if strategy in NEED_NO_METRIC else 1.0
    return [p | {"seconds": p["render_seconds"] + own * p["decision_seconds"]} for p in points]


def _hash(named: list[Any]) -> str:
    return hashlib.sha256(json.dumps(named, default=str, sort_keys=True).encode()).hexdigest()[:20]
