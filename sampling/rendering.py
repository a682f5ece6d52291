"""A scene rendered until nobody can see what is still missing: one run, from scene to picture.

`sampling.render` does this, and so does ``vdm-render``.
"""

import contextlib
import json
import os
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sampling import checkpoint as checkpoints
from sampling import plan as plans
from sampling.plan import AUTO, FULL, Pilot, Plan
from sampling.renderers import Samples
from sampling.renderers.filter import SCENE
from sampling.renderers.mitsuba import MitsubaRenderer, preserved
from sampling.sampler import Report, Sampler, Settings, StrategyName, rounds, under
from torch_vdm import VDM, Display, Observer, __version__
from torch_vdm.io import write_channels
from torch_vdm.model.distance import VISIBLE

Plane = NDArray[np.float64]

# Seconds between two checkpoints. Status: choice.
CHECKPOINT_SECONDS = 30.0

# Samples between two looks at the clock: the first number, then as many as take about so many
# seconds, within limits. None changes a bit of the image. Status: choice; a call has to be large
# to be fast.
FIRST_PART, SMALLEST_PART, LARGEST_PART = 2**16, 2**12, 2**20
PART_SECONDS = 0.5

# Pixels below which the metric runs on one thread: more threads would gain little, and on busy
# cores they wait for each other. Status: choice; measured at 96 x 64 on two busy cores, where two
# threads took 10 s for what one does in 0.7 s.
FEW_PIXELS = 2**18

# Seconds between two changes of the live line.
LINE_SECONDS = 0.2

# The values of `effects`.
EFFECTS = (AUTO, FULL)


class Watch:
    """Follows a run while it goes on, and may end it; this base class does nothing."""

    def begin(self) -> None:
        """Take note that the scene is loaded and rendering begins."""

    def round(self, report: Report | None) -> None:
        """Take note of a round."""

    def part(self, samples: int, speed: float) -> None:
        """Take note of samples so far and samples a second."""

    def presses(self) -> int:
        """Return 0 to go on, 1 to end with the round, 2 to end at once."""
        return 0


@dataclass(frozen=True, eq=False)
class Result:
    """A rendered picture, and what is known of it."""

    image: Plane
    """(H, W, 3), linear BT.709. Filters with negative lobes may go below 0."""
    samples: NDArray[np.int64]
    """(H, W), the number of samples in each pixel's mean."""
    jnd: Plane
    """(H, W), the predicted visible difference from the converged image, in JND; infinite where
    the run ended before it was predicted."""
    variance: Plane
    """(H, W, 3), the estimated variance of ``image``."""
    aovs: dict[str, Plane]
    """(H, W) each, by name of channel: alpha (A) where the scene's film has it, and albedo, shading
    normal and depth where they were asked for."""
    report: Report | None
    """The report of the last decision; None where the run ended before the first."""
    stop_reason: str
    """tolerance, noise_threshold, max_spp, time_limit or interrupted."""
    converged: bool
    """Whether it stopped because nobody should see what is missing, in any pixel."""
    figures: dict[str, Any]
    """The entries of ``vdm-render --json``, except those about its command."""
    header: dict[str, str]
    """The entries of the file's header, besides its channels."""
    _run: "_Run" = field(repr=False)
    """The run, from which a checkpoint is made."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write an OpenEXR file of 32-bit floats, whole or not at all.

        Its channels: R, G, B, and A where the scene's film has it; samples; jnd; variance.R, .G,
        .B; albedo.R, .G, .B, normal.X, .Y, .Z and depth.Z where they were asked for. Its header
        names the reconstruction filter, as ``pixelFilter``, and what was left out, as ``plan``.

        Raises
        ------
        ImageError
            If the name does not end in ``.exr``, or the file cannot be written.
        """
        planes: dict[str, NDArray[Any]] = dict(
            zip("RGB", np.moveaxis(self.image, -1, 0), strict=True)
        )
        planes["samples"], planes["jnd"] = self.samples, self.jnd
        for name, plane in zip("RGB", np.moveaxis(self.variance, -1, 0), strict=True):
            planes[f"variance.{name}"] = plane
        planes |= self.aovs
        tensors = {name: torch.tensor(p, dtype=torch.float32) for name, p in planes.items()}
        write_channels(path, tensors, self.header)

    def save_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """Write a checkpoint from which a later run continues with ``resume``.

        Raises
        ------
        CheckpointError
            If it cannot be written, or the scene is not in a file.
        """
        self._run.save(Path(path))


def render(
    scene: Any,
    tolerance: float = 1.0,
    ppd: float = 60.0,
    white: float = 100.0,
    sensor: Any = 0,
    seed: int = 0,
    filter: str = SCENE,  # noqa: A002  # what --filter is called
    *,
    effects: str = "auto",
    observer: Observer | None = None,
    strategy: StrategyName = "perceptual",
    max_spp: int | None = None,
    time_limit: float | None = None,
    noise_threshold: float | None = None,
    unbiased: bool = False,
    aov: bool | str = False,
    integrator: Any = None,
    parameters: dict[str, str] | None = None,
    variant: str = "auto",
    checkpoint: str | os.PathLike[str] | None = None,
    resume: str | os.PathLike[str] | None = None,
    watch: Watch | None = None,
) -> Result:
    """Render a scene of Mitsuba until nobody can see what is still missing.

    The same arguments give the same image, bit for bit, except with ``time_limit``. For images of
    2^18 pixels and more the number of torch threads counts as an argument: the figures report it,
    and a run that continues from a checkpoint uses the number it began with. Mitsuba's variant and
    log level, and the numbers of threads, are restored afterwards.

    Parameters
    ----------
    scene
        An XML file, a dict as `mi.load_dict` takes it, or an `mi.Scene`, which is left as it is.
    tolerance
        Largest visible difference that may be left anywhere in the image, in JND, over 0.
    ppd
        Pixels per degree of vision, over 0.
    white
        Luminance of 1.0 in the picture, in cd/m2, over 0.
    sensor
        Number, from 0 on, or id, or an `mi.Sensor`.
    seed
        0 to 2^32 - 1; other seeds give independent images.
    filter
        The pixels' reconstruction filter: "scene", the film's own, or box, tent, gaussian,
        mitchell, catmullrom or lanczos.
    effects
        "auto": what nobody could see is left out, see `sampling.plan`; "full": nothing is.
    observer
        The observer that judges; None: `Observer.calibrated`.
    strategy, max_spp, noise_threshold, unbiased
        See `Settings`.
    time_limit
        Seconds, loading the scene included; the first round is always completed. None: no limit.
    aov
        Whether to average albedo, shading normal and depth from the same rays; "own": the
        integrator's own AOVs.
    integrator
        An `mi.Integrator` to render with in place of the scene's own; there is no checkpoint then.
    parameters, variant
        See `MitsubaRenderer`.
    checkpoint
        A file that is written now and then, and at the end. None: none.
    resume
        A file to continue from; if there is none yet, the run starts anew, with a warning.
    watch
        Follows the run, and may end it. If standard error is a terminal, a line on it shows the
        progress in any case.

    Returns
    -------
    Result
        The picture and what is known of it, with ``save``.

    Raises
    ------
    ValueError
        With a message of one line, if an option is out of its range, the scene cannot be rendered
        (`SceneError`), or a checkpoint is of another run, or that of an interrupted run cannot be
        written (`CheckpointError`).
    """
    begun = time.monotonic()
    # NumPy numbers cannot be written as JSON.
    tolerance, ppd, white, seed = float(tolerance), float(ppd), float(white), int(seed)
    if effects not in EFFECTS:
        raise ValueError(f"expected effects among {', '.join(EFFECTS)}, got {effects!r}")
    if time_limit is not None and not time_limit > 0.0:
        raise ValueError(f"expected a time limit over 0 s, got {time_limit}")
    settings = Settings(
        strategy=strategy,
        tolerance=tolerance,
        max_spp=max_spp,
        noise_threshold=noise_threshold,
        unbiased=unbiased,
    )
    observer = observer or Observer.calibrated()
    metric = VDM(ppd, Display.linear(white), observer)
    with preserved():
        renderer = MitsubaRenderer(
            scene,
            parameters,
            sensor=sensor,
            seed=seed,
            aov=aov,
            integrator=integrator,
            filter=filter,
            variant=variant,
        )
        height, width = renderer.size
        # The sampler's own state has its settings; the rest is recorded here.
        identity = {
            **asdict(settings),
            "version": __version__,
            "mitsuba": renderer.version,
            "variant": renderer.variant,
            "size": f"{width} x {height}",
            "scene": renderer.fingerprint,
            "sensor": renderer.sensor[0],
            "seed": seed,
            "ppd": ppd,
            "white": white,
            "observer": observer.name,
            "observer_numbers": json.dumps(asdict(observer), sort_keys=True),
            "aov": aov,
            "filter": filter,
        }
        plan, piloted = plans.read(renderer.needs, effects, settings, renderer.size)
        sampler = Sampler(renderer.size, metric, settings)
        threads = 1 if height * width < FEW_PIXELS else torch.get_num_threads()
        run = _Run(renderer, sampler, identity, begun, threads, effects, plan, piloted)
        if checkpoint is not None or resume is not None:
            run.check_kept()
        if resume is not None:
            run.go_on(Path(resume))
        if run.plan.integrator is not None:
            renderer.simulate(run.plan.max_depth, run.plan.found_by)
        with (
            _threads(run.threads),
            _told(watch or Watch(), tolerance) as told,
        ):
            told.begin()
            reason = run.until_done(told, time_limit or np.inf, checkpoint)
        if checkpoint is not None:
            run.save_last(Path(checkpoint), reason)
        return run.result(reason)


class _EndedError(Exception):
    """The run ends without waiting for a decision."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class _Clock:
    """A renderer whose time is measured, as is all other time."""

    def __init__(self, renderer: MitsubaRenderer, seconds: dict[str, float]) -> None:
        self.size = renderer.size
        self.speed = 0.0
        """Samples a second."""
        self._renderer, self._seconds = renderer, seconds
        self._before = time.perf_counter()
        self._drawn, self._drawing = 0, 0.0

    def spent(self, what: str | None) -> float:
        """Charge the time since the last call to an entry, or to none, and return it."""
        now = time.perf_counter()
        passed, self._before = now - self._before, now
        if what is not None:
            self._seconds[what] += passed
        return passed

    def sample(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> Samples:
        """Draw what the renderer draws."""
        self.spent("metric")
        samples = self._renderer.sample(pixels, first, count)
        self.drew(len(samples.pixels))
        return samples

    def drew(self, samples: int) -> None:
        """Charge the time since the last call to so many samples."""
        self._drawing += self.spent("render")
        self._drawn += samples
        self.speed = self._drawn / self._drawing

    def at_once(self) -> int:
        """Return how many samples to draw between two looks at the clock."""
        if not self._drawn:
            return FIRST_PART
        return int(np.clip(PART_SECONDS * self.speed, SMALLEST_PART, LARGEST_PART))


@dataclass
class _Run:
    """A scene, its sampler, and the cost of the run, including earlier parts of it."""

    renderer: MitsubaRenderer
    sampler: Sampler
    identity: dict[str, Any]
    begun: float
    """When this part of the run began, by the monotonic clock."""
    threads: int
    """Threads of the metric, on which the last bits depend; a run keeps their number."""
    effects: str
    plan: Plan
    piloted: bool
    """Whether a pilot is still to refine the plan."""
    samples: int = 0
    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("render", "metric", "total"), 0.0)
    )
    """Seconds for rays and for deciding, and the total of the parts before this one."""

    def check_kept(self) -> None:
        """Refuse a checkpoint of a scene that could not be recognized."""
        if not self.renderer.fingerprint:
            raise checkpoints.CheckpointError(
                "expected a scene in a file with a checkpoint, got one of which nobody could tell "
                "whether it is the same; give its path"
            )

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        self.check_kept()
        state = {f"sampler.{name}": v for name, v in self.sampler.state().items()}
        if self.renderer.aov_sums is not None:
            state["aov_sums"] = self.renderer.aov_sums
        state["progress.samples"] = self.samples
        state["plan"] = json.dumps(
            {"effects": self.effects, "piloted": self.piloted, "plan": self.plan.state()}
        )
        state["progress.threads"] = self.threads
        for name, seconds in (self.seconds | {"total": self._total()}).items():
            state[f"progress.seconds_{name}"] = seconds
        checkpoints.save(path, checkpoints.Checkpoint(self.identity, state))

    def save_last(self, path: Path, reason: str) -> None:
        """Write the checkpoint at the end; where the run is done, its picture does not need it."""
        try:
            self.save(path)
        except checkpoints.CheckpointError as error:  # a full disk
            if reason == "interrupted":
                raise
            warnings.warn(f"{error}; the picture is not affected", stacklevel=3)

    def go_on(self, path: Path) -> None:
        """Continue from a checkpoint, or start anew if there is none yet: the image is the same."""
        if not path.exists():
            warnings.warn(f"{path}: no checkpoint yet; starting from the beginning", stacklevel=3)
            return
        state = checkpoints.load(path, self.identity)
        try:
            begun = json.loads(state["plan"])
            if begun["piloted"]:
                warnings.warn(
                    f"{path}: ended within the first round, of which nothing is kept; starting "
                    "from the beginning",
                    stacklevel=3,
                )
                return
            self._take_over(path, begun)
            self.sampler = Sampler.restore(under("sampler.", state), self.sampler.metric)
            self.samples, self.threads = state["progress.samples"], state["progress.threads"]
            self.seconds = {name: state[f"progress.seconds_{name}"] for name in self.seconds}
            if self.renderer.aov_sums is not None:
                self.renderer.aov_sums[:] = state["aov_sums"]
        except (KeyError, TypeError) as error:
            raise checkpoints.CheckpointError(
                f"{path}: expected a whole checkpoint, got one without {error}; "
                "start anew without --resume"
            ) from error

    def _take_over(self, path: Path, begun: dict[str, Any]) -> None:
        """Adopt the plan of a checkpoint, or refuse it where another one would be made."""
        plan = Plan.restored(begun["plan"])
        if begun["effects"] != self.effects:
            # A run that has kept everything so far may continue to do so.
            if plan.integrator is not None or self.plan.integrator is not None:
                raise checkpoints.CheckpointError(
                    f"{path}: begun with --effects {begun['effects']}, and this is {self.effects}; "
                    "give the same, or start anew without --resume"
                )
            if self.piloted:
                reason = f"every bounce: begun with --effects {begun['effects']}"
                self.plan = replace(self.plan, kept=(*self.plan.kept, reason))
        else:
            self.plan = plan
        self.piloted = False

    def report(self) -> Report | None:
        """Return the last decision's report, with the bound on what is left out added."""
        report, bound = self.sampler.report(), self.plan.bound
        if report is None or not bound:
            return report
        return report._replace(predicted=report.predicted + bound, jnd=report.jnd + bound)

    def _draw_pilot(self, watch: Watch, clock: _Clock, look: Callable[[], None]) -> Pilot:
        """Draw the first round, which records more of each sample than its light."""
        pilot = Pilot(self.plan, self.renderer, self.sampler)
        clock.spent("metric")
        for part in pilot.steps():
            clock.drew(part)
            self.samples += part
            watch.part(self.samples, clock.speed)
            look()
        return pilot

    def _settle(self, pilot: Pilot, report: Report, look: Callable[[], None]) -> None:
        """Adopt the pilot's plan and sampler, unless the run ends with its round.

        Where ``look`` ends it, nothing is adopted, and the run is one without a plan.
        """
        if report.stop_reason is not None:
            self.plan = self.plan.ended()
        else:
            pilot.settle(look)
            self.sampler, self.plan = pilot.sampler, pilot.plan
        self.piloted = False

    def until_done(
        self, watch: Watch, time_limit: float, checkpoint: str | os.PathLike[str] | None
    ) -> str:
        """Render until the sampler, the clock or the user says stop; return the reason."""
        saved = time.monotonic()
        clock = _Clock(self.renderer, self.seconds)

        def listen() -> None:
            """End the run at once where the user wants it."""
            if watch.presses() > 1:
                raise _EndedError("interrupted")

        def look() -> None:
            """End the run at once where nothing more is to be done."""
            listen()
            # The first round is always completed: without it there is no image, and no prediction.
            late = time.monotonic() - self.begun > time_limit
            if late and self.sampler.report() is not None:
                raise _EndedError("time_limit")

        def told(samples: int) -> None:
            nonlocal saved
            self.samples += samples
            watch.part(self.samples, clock.speed)
            if checkpoint is not None and time.monotonic() - saved > CHECKPOINT_SECONDS:
                clock.spent("metric")
                try:
                    self.save(Path(checkpoint))
                except checkpoints.CheckpointError as error:  # a full disk: no reason to stop
                    warnings.warn(str(error), stacklevel=5)
                saved = time.monotonic()
                clock.spent(None)

        try:
            pilot = self._draw_pilot(watch, clock, look) if self.piloted else None
            while True:
                for report in rounds(self.sampler, clock, clock.at_once, look=look, told=told):
                    if pilot is not None and self.piloted:
                        self._settle(pilot, report, listen)
                        if report.stop_reason is None:
                            break  # continue with another sampler where something is left out
                    watch.round(self.report())
                    if report.stop_reason is not None:
                        return report.stop_reason
                    if watch.presses():
                        return "interrupted"
        except _EndedError as ending:
            return ending.reason
        finally:
            clock.spent("metric")

    def result(self, reason: str) -> Result:
        """Return the picture and what is known of it."""
        sampler, renderer, report = self.sampler, self.renderer, self.report()
        plan = self.plan.ended() if self.piloted else self.plan
        height, width = renderer.size
        empty = int((sampler.count == 0).sum())
        # A pixel without a finite sample is black, and nothing is known of it.
        converged = report is not None and report.converged and not empty
        identity = self.identity
        figures = {
            **{name: identity[name] for name in ("strategy", "seed", "tolerance")},
            "rounds": report.round if report is not None else 0,
            "samples_total": self.samples,
            "spp_mean": self.samples / (height * width),
            "predicted_max_jnd": report.predicted if report is not None else None,
            "visible_fraction": (
                float((report.jnd > VISIBLE).mean()) if report is not None else None
            ),
            "over_tolerance_fraction": report.over if report is not None else None,
            "converged": converged,
            "stop_reason": reason,
            "seconds_render": self.seconds["render"],
            "seconds_metric": self.seconds["metric"],
            "seconds_total": self._total(),
            "threads": self.threads,
            "variant": renderer.variant,
            "plan": {"effects_option": self.effects, **plan.figures(), **renderer.plan()},
            "samples_min": int(sampler.count.min()),
            "samples_max": int(sampler.count.max()),
            "nonfinite": report.nonfinite if report is not None else 0,
            "pixels_empty": empty,
            "black": not sampler.image.any(),
            "grey": sampler.grey,
            "unbiased": identity["unbiased"],
            "width": width,
            "height": height,
            **{name: identity[name] for name in ("ppd", "white", "observer", "filter")},
            "sensor": renderer.sensor[1] or renderer.sensor[0],
            "sensors": renderer.sensors,
            "version": __version__,
            "mitsuba": renderer.version,
            "fingerprint": identity["scene"],
        }
        return Result(
            image=sampler.image,
            samples=sampler.count.copy(),
            jnd=report.jnd if report is not None else np.full(sampler.size, np.inf),
            variance=sampler.variance,
            aovs=renderer.aovs(),
            report=report,
            stop_reason=reason,
            converged=converged,
            figures=figures,
            header={
                "software": f"vdm-render {__version__}",
                "pixelFilter": renderer.pixel_filter.words,
                "plan": "; ".join(plan.words()),
            },
            _run=self,
        )

    def _total(self) -> float:
        """Return the seconds of the run, those before an interruption included."""
        return self.seconds["total"] + time.monotonic() - self.begun


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    """Run torch on so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def terminal() -> Any:
    """Return the console of standard error; its ``is_terminal`` says whether it shows a line."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, markup=False)


@contextlib.contextmanager
def _told(watch: Watch, tolerance: float) -> Iterator[Watch]:
    """Show a live line on a terminal, in addition to the given watch."""
    from rich.live import Live

    console = terminal()
    if not console.is_terminal:
        yield watch
        return
    with Live(console=console, transient=True, auto_refresh=False) as live:
        yield _LiveLine(live, tolerance, watch)


class _LiveLine(Watch):
    """One line that is redrawn in place."""

    def __init__(self, live: Any, tolerance: float, beside: Watch) -> None:
        self._live, self._tolerance, self._beside = live, tolerance, beside
        self._report: Report | None = None
        self._shown = 0.0

    def begin(self) -> None:
        self._beside.begin()

    def presses(self) -> int:
        return self._beside.presses()

    def round(self, report: Report | None) -> None:
        self._report = report
        self._beside.round(report)

    def part(self, samples: int, speed: float) -> None:
        self._beside.part(samples, speed)
        now = time.monotonic()
        if now - self._shown < LINE_SECONDS:
            return
        self._shown = now
        report = self._report
        words = [f"round {1 if report is None else report.round + 1}"]
        if report is not None:
            words += [f"{samples / report.jnd.size:.4g} samples per pixel"]
            words += seen(report, self._tolerance)
        words += [f"{speed / 1e6:.2f} million samples/s"]
        if report is not None:
            left = max(report.samples + report.forecast - samples, 0) / speed
            words += [f"{_clock(left)} left"]
        if self.presses():
            words += ["ending with this round (Ctrl-C again: at once)"]
        self._live.update(" · ".join(words), refresh=True)


def seen(report: Report, tolerance: float) -> list[str]:
    """Return in words what a round's decision predicted."""
    return [
        f"predicted maximum {report.predicted:.3g} JND",
        f"{100.0 * report.over:.3g} % over {tolerance:g}",
    ]


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
