"""The command line, ``vdm-render``: render a scene until nobody sees what is still missing."""

import argparse
import contextlib
import json
import shlex
import signal
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import OpenEXR
import torch

from sampling import checkpoint
from sampling.renderers.filter import FILTERS, SCENE
from sampling.renderers.mitsuba import VARIANTS, MitsubaRenderer
from sampling.sampler import Report, Sampler, Settings, under
from sampling.strategies import STRATEGIES
from torch_vdm import VDM, Display, __version__
from torch_vdm.cli import (
    DONE,
    INTERRUPTED,
    OBSERVERS,
    PPD,
    WHITE,
    Parser,
    UsageError,
    check_outputs,
    json_path,
    parsed,
    positive,
    run,
    tell,
)
from torch_vdm.distance import VISIBLE
from torch_vdm.io import atomic_path, write_channels

# Seconds between two checkpoints. Status: choice.
CHECKPOINT_SECONDS = 30.0

# Samples between two looks at the clock: at first, and then as many as take about so long. Neither
# changes a bit of the image. Status: choice; a call has to be large to be fast.
FIRST_PART, SMALLEST_PART, LARGEST_PART = 2**16, 2**12, 2**20
PART_SECONDS = 0.5

# Pixels below which the metric runs on one thread: more would gain little, and where the cores are
# busy they wait for each other. Status: choice; measured at 96 x 64 on two busy cores, two threads
# took 10 s for what one does in 0.7 s.
FEW_PIXELS = 2**18

# Seconds between two changes of the live line.
LINE_SECONDS = 0.2


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``vdm-render``; return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Scenes and settings are refused with plain ValueErrors.
    return run("vdm-render", lambda: _run(parsed(_parser(), words), words), (ValueError,))


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="vdm-render",
        description="Render a scene of Mitsuba until nobody can see what is still missing. "
        "Exit status: 0 done, 2 bad input, 3 internal error, 130 interrupted.",
    )
    parser.add_argument("--version", action="version", version=f"vdm-render {__version__}")
    parser.add_argument("scene", type=Path, metavar="SCENE.xml")
    parser.add_argument("--output", type=Path, required=True, metavar="OUT.exr")
    where = parser.add_argument_group("where samples go, and when there are enough")
    where.add_argument("--strategy", choices=tuple(STRATEGIES), default="perceptual")
    where.add_argument(
        "--tolerance",
        type=positive,
        default=1.0,
        metavar="JND",
        help="largest visible difference that may be left (1)",
    )
    where.add_argument(
        "--max-spp", type=_count, metavar="N", help="most samples of any pixel; default: no limit"
    )
    where.add_argument(
        "--time-limit", type=positive, metavar="SECONDS", help="stop then, whatever is visible"
    )
    where.add_argument(
        "--noise-threshold", type=positive, metavar="F", help="halfbuffer's own stop"
    )
    where.add_argument(
        "--unbiased", action="store_true", help="show other samples than those that decided"
    )
    where.add_argument("--seed", type=_seed, default=0, metavar="N")
    view = parser.add_argument_group("viewing")
    view.add_argument(
        "--ppd", type=positive, default=PPD, metavar="F", help=f"pixels per degree ({PPD:g})"
    )
    view.add_argument(
        "--white",
        type=positive,
        default=WHITE,
        metavar="CD_M2",
        help=f"luminance of 1.0 in the picture ({WHITE:g})",
    )
    view.add_argument("--observer", choices=tuple(OBSERVERS), default="calibrated")
    scene = parser.add_argument_group("scene")
    scene.add_argument("--effects", choices=("auto", "full"), default="auto")
    scene.add_argument(
        "--aov",
        action="store_true",
        help="write albedo, shading normal and depth, from the same rays",
    )
    scene.add_argument(
        "--filter",
        choices=FILTERS,
        default=SCENE,
        help="reconstruction filter of the pixels; scene: its film's own (scene)",
    )
    scene.add_argument(
        "--variant", choices=("auto", *VARIANTS), default="auto", help="of Mitsuba (auto)"
    )
    scene.add_argument(
        "-D",
        dest="parameters",
        type=_parameter,
        action="append",
        default=[],
        metavar="name=value",
        help="a parameter of the scene; may be given again",
    )
    output = parser.add_argument_group("output")
    output.add_argument(
        "--checkpoint", type=Path, metavar="FILE", help="save the run there now and then"
    )
    output.add_argument(
        "--resume", action="store_true", help="go on where the checkpoint ends; the same image"
    )
    output.add_argument("--json", metavar="OUT.json|-", help="the figures; - prints them alone")
    return parser


@dataclass
class _Progress:
    """What a run has cost, over all its interruptions."""

    samples: int = 0
    seconds_render: float = 0.0
    seconds_metric: float = 0.0
    seconds_total: float = 0.0
    begun: float = field(default_factory=time.monotonic)
    """When this part of the run began."""

    @property
    def total(self) -> float:
        """Seconds of the run, those before an interruption included."""
        return self.seconds_total + time.monotonic() - self.begun

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {
            "progress.samples": self.samples,
            "progress.seconds_render": self.seconds_render,
            "progress.seconds_metric": self.seconds_metric,
            "progress.seconds_total": self.total,
        }


class _Interrupt:
    """Counts Ctrl-C: the first ends the run after its round, the second at once.

    A request to terminate, as of a cluster's scheduler, ends it at once too. What there is is
    written whole all the same; a third Ctrl-C gives that up.
    """

    def __init__(self) -> None:
        self.count = 0

    def __enter__(self) -> "_Interrupt":
        kinds = signal.SIGINT, signal.SIGTERM
        self._before = {kind: signal.signal(kind, self._note) for kind in kinds}
        return self

    def __exit__(self, *_: object) -> None:
        for kind, handler in self._before.items():
            signal.signal(kind, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count = max(2, self.count) if number == signal.SIGTERM else self.count + 1
        if self.count >= 3:
            signal.default_int_handler(number, frame)


@dataclass
class _Job:
    """A scene, its sampler, and what is known of the run so far."""

    options: argparse.Namespace
    renderer: MitsubaRenderer
    sampler: Sampler
    progress: _Progress
    identity: dict[str, Any]

    def save(self, path: Path) -> None:
        """Write a checkpoint."""
        state = {f"sampler.{name}": v for name, v in self.sampler.state().items()}
        if self.renderer.aov_sums is not None:
            state["aov_sums"] = self.renderer.aov_sums
        checkpoint.save(path, checkpoint.Checkpoint(self.identity, state | self.progress.state()))

    def render(self, interrupt: _Interrupt, line: "_Line") -> str:
        """Render until the sampler, the clock or the user says stop; return the reason."""
        options, progress, sampler = self.options, self.progress, self.sampler
        saved = time.monotonic()
        at_once = FIRST_PART
        drawn, drawing = 0, 0.0
        while True:
            start = time.perf_counter()
            request = sampler.ask()
            progress.seconds_metric += time.perf_counter() - start
            report = sampler.report()
            line.round(report)
            if request is None:
                assert report is not None
                assert report.stop_reason is not None
                return report.stop_reason
            if report is not None and interrupt.count:
                return "interrupted"
            for part in request.parts(at_once):
                start = time.perf_counter()
                samples = self.renderer.sample(part.pixels, part.first, part.count)
                middle = time.perf_counter()
                sampler.tell(samples)
                end = time.perf_counter()
                progress.samples += part.samples
                progress.seconds_render += middle - start
                progress.seconds_metric += end - middle
                drawn, drawing = drawn + part.samples, drawing + middle - start
                line.part(progress.samples, drawn / drawing, interrupt.count > 0)
                if options.checkpoint and time.monotonic() - saved > CHECKPOINT_SECONDS:
                    try:
                        self.save(options.checkpoint)
                    except checkpoint.CheckpointError as error:  # a full disk: no reason to stop
                        print(f"vdm-render: warning: {error}", file=sys.stderr)
                    saved = time.monotonic()
                if interrupt.count > 1:
                    return "interrupted"
                # The pilot is always completed: without it there is no image.
                late = time.monotonic() - progress.begun > (options.time_limit or np.inf)
                if late and report is not None:
                    return "time_limit"
            speed = drawn / drawing
            at_once = int(np.clip(PART_SECONDS * speed, SMALLEST_PART, LARGEST_PART))

    def write(self) -> None:
        """Write the image."""
        sampler, report = self.sampler, self.sampler.report()
        planes = dict(zip("RGB", np.moveaxis(sampler.image, -1, 0), strict=True))
        planes["samples"] = sampler.count
        planes["jnd"] = report.jnd if report is not None else np.full(sampler.size, np.inf)
        for name, plane in zip("RGB", np.moveaxis(sampler.variance, -1, 0), strict=True):
            planes[f"variance.{name}"] = plane
        planes |= self.renderer.aovs()
        tensors = {name: torch.tensor(p, dtype=torch.float32) for name, p in planes.items()}
        header = {
            "software": f"vdm-render {__version__}",
            "pixelFilter": self.renderer.pixel_filter.words,
        }
        with atomic_path(self.options.output) as temporary:
            write_channels(temporary, tensors)
            with OpenEXR.File(str(temporary), separate_channels=True) as file:
                file.header().update(header)
                file.write(str(temporary))

    def figures(self, reason: str) -> dict[str, Any]:
        """Return what the JSON says."""
        options, report, progress = self.options, self.sampler.report(), self.progress
        height, width = self.renderer.size
        empty = int((self.sampler.count == 0).sum())
        return {
            "strategy": options.strategy,
            "seed": options.seed,
            "tolerance": options.tolerance,
            "rounds": report.round if report is not None else 0,
            "samples_total": progress.samples,
            "spp_mean": progress.samples / (height * width),
            "predicted_max_jnd": report.predicted if report is not None else None,
            "visible_fraction": (
                float((report.jnd > VISIBLE).mean()) if report is not None else None
            ),
            "over_tolerance_fraction": report.over if report is not None else None,
            # A pixel without a finite sample is black, and nothing is known of it.
            "converged": report is not None and report.converged and not empty,
            "stop_reason": reason,
            "seconds_render": progress.seconds_render,
            "seconds_metric": progress.seconds_metric,
            "seconds_total": progress.total,
            "variant": self.renderer.variant,
            "plan": _plan(self.renderer, options),
            "samples_min": int(self.sampler.count.min()),
            "samples_max": int(self.sampler.count.max()),
            "nonfinite": report.nonfinite if report is not None else 0,
            "pixels_empty": empty,
            "unbiased": options.unbiased,
            "width": width,
            "height": height,
            "ppd": options.ppd,
            "white": options.white,
            "observer": options.observer,
            "filter": options.filter,
            "scene": str(options.scene),
            "version": __version__,
            "mitsuba": self.renderer.version,
            "reproduce": _reproduce(options),
        }


def _run(options: argparse.Namespace, words: list[str]) -> int:
    _check(options)
    progress = _Progress()
    settings = Settings(
        strategy=options.strategy,
        tolerance=options.tolerance,
        max_spp=options.max_spp,
        noise_threshold=options.noise_threshold,
        unbiased=options.unbiased,
    )
    metric = VDM(options.ppd, Display.linear(options.white), OBSERVERS[options.observer]())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        renderer = MitsubaRenderer(
            options.scene,
            dict(options.parameters),
            seed=options.seed,
            aov=options.aov,
            filter=options.filter,
            variant=options.variant,
        )
    for warning in told:
        if warning.category is UserWarning:  # the renderer's own, not what libraries deprecate
            print(f"vdm-render: warning: {warning.message}", file=sys.stderr)
    # The sampler's own state says which settings it has; the rest is said here.
    height, width = renderer.size
    identity = {
        **asdict(settings),
        "version": __version__,
        "mitsuba": renderer.version,
        "variant": renderer.variant,
        "size": f"{width} x {height}",
        "scene": renderer.fingerprint,
        **{name: getattr(options, name) for name in ("seed", "ppd", "white", "observer")},
        "filter": options.filter,
        "aov": options.aov,
    }
    kept = options.checkpoint or options.output.with_name(f"{options.output.name}.checkpoint")
    sampler = _resumed(kept, identity, metric, renderer, progress) if options.resume else None
    job = _Job(
        options, renderer, sampler or Sampler(renderer.size, metric, settings), progress, identity
    )
    few = height * width < FEW_PIXELS
    with _threads(1 if few else torch.get_num_threads()), _Interrupt() as interrupt:
        with _live(options) as line:
            reason = job.render(interrupt, line)
        job.write()
        if options.checkpoint or reason == "interrupted":
            job.save(kept)
    figures = job.figures(reason)
    if options.json == "-":
        tell(json.dumps(figures, indent=2) + "\n")
    else:
        if options.json is not None:
            with atomic_path(Path(options.json)) as temporary:
                temporary.write_text(json.dumps(figures, indent=2) + "\n")
        tell(_text(figures, options))
    if reason != "interrupted":
        return DONE
    again = [word for word in words if word != "--resume"]
    if options.checkpoint is None:
        again += ["--checkpoint", str(kept)]
    print(
        f"vdm-render: interrupted; go on with: {shlex.join(['vdm-render', *again, '--resume'])}",
        file=sys.stderr,
    )
    return INTERRUPTED


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    """Have torch compute on so many threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _resumed(
    path: Path,
    identity: dict[str, Any],
    metric: VDM,
    renderer: MitsubaRenderer,
    progress: _Progress,
) -> Sampler | None:
    """Return the sampler that a checkpoint holds; None, and a word, where there is no file yet."""
    if not path.exists():
        # A run that was killed before its first checkpoint begins anew: the same image.
        print(
            f"vdm-render: {path}: no checkpoint yet; starting from the beginning", file=sys.stderr
        )
        return None
    state = checkpoint.load(path, identity)
    try:
        sampler = Sampler.restore(under("sampler.", state), metric)
        progress.samples = state["progress.samples"]
        progress.seconds_render = state["progress.seconds_render"]
        progress.seconds_metric = state["progress.seconds_metric"]
        progress.seconds_total = state["progress.seconds_total"]
        if renderer.aov_sums is not None:
            renderer.aov_sums[:] = state["aov_sums"]
    except (KeyError, TypeError) as error:
        raise checkpoint.CheckpointError(
            f"{path}: expected a whole checkpoint, got one without {error}; "
            "start anew without --resume"
        ) from error
    return sampler


def _check(options: argparse.Namespace) -> None:
    """Refuse, before anything is rendered, what could not be written or would destroy an input."""
    if options.output.suffix.lower() != ".exr":
        raise UsageError(f"{options.output}: expected a name that ends in .exr")
    outputs = (options.output, options.checkpoint, json_path(options))
    check_outputs((options.scene,), outputs)


def _plan(renderer: MitsubaRenderer, options: argparse.Namespace) -> dict[str, Any]:
    """Return what is simulated and why."""
    why = {
        "auto": "nothing is left out yet: what the scene names is simulated",
        "full": "asked for: what the scene names is simulated",
    }[options.effects]
    return {"effects_option": options.effects, "why": why, **renderer.plan()}


def _reproduce(options: argparse.Namespace) -> str:
    """Return the command that gives the same image, with nothing left to defaults."""
    words = ["vdm-render", str(options.scene), "--output", str(options.output)]
    for name in ("strategy", "tolerance", "max_spp", "time_limit", "noise_threshold", "seed"):
        value = getattr(options, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    for name in ("ppd", "white", "observer", "effects", "filter", "variant"):
        words += [f"--{name}", str(getattr(options, name))]
    words += [f"--{name}" for name in ("unbiased", "aov") if getattr(options, name)]
    for name, value in options.parameters:
        words += ["-D", f"{name}={value}"]
    return shlex.join(words)


_ENDINGS = {
    "tolerance": "Nobody should see what is missing",
    "noise_threshold": "The noise threshold is reached",
    "max_spp": "Stopped by --max-spp, whatever is visible",
    "time_limit": "Stopped by --time-limit, whatever is visible",
    "interrupted": "Interrupted, whatever is visible",
}


def _text(figures: dict[str, Any], options: argparse.Namespace) -> str:
    """Return in words how it ended, what it cost, what was assumed and what was written."""
    lines = [_ENDINGS[figures["stop_reason"]]]
    if figures["predicted_max_jnd"] is not None:
        lines[0] += (
            f": predicted maximum {figures['predicted_max_jnd']:.3g} JND, "
            f"tolerance {figures['tolerance']:g}"
        )
    lines[0] += "."
    lines += [
        f"{figures['spp_mean']:.4g} samples per pixel ({figures['samples_min']} to "
        f"{figures['samples_max']}), {figures['rounds']} rounds, "
        f"{figures['seconds_total']:.1f} s: rendering {figures['seconds_render']:.1f}, "
        f"metric {figures['seconds_metric']:.1f}.",
        "",
    ]
    if figures["nonfinite"]:
        lines.append(
            f"left out: {figures['nonfinite']} samples that were NaN or infinite; "
            "check the scene's materials"
        )
    if figures["pixels_empty"]:
        lines.append(
            f"black: {figures['pixels_empty']} pixels that have no finite sample; "
            "nothing can be said of them"
        )
    plan = figures["plan"]
    depth = "no limit of depth" if plan["max_depth"] is None else f"depth {plan['max_depth']}"
    simulated = [each["effect"] for each in plan["effects"] if each["simulated"]]
    lines += [
        f"simulated: {plan['integrator']}, {depth}, {figures['variant']}, "
        f"{plan['pixel_filter']} filter" + "".join(f", {effect}" for effect in simulated),
        f"assumed: {options.ppd:g} pixels per degree (--ppd)",
        f"assumed: 1.0 is {options.white:g} cd/m2 (--white)",
        f"assumed: the {options.observer} observer (--observer)",
    ]
    lines += [
        f"written: {path}"
        for path in (options.output, options.checkpoint, options.json)
        if path is not None
    ]
    return "\n".join(lines) + "\n"


class _Line:
    """What the user sees while it renders; by itself nothing."""

    def round(self, report: Report | None) -> None:
        """Take note of a round."""

    def part(self, samples: int, speed: float, ending: bool) -> None:
        """Take note of samples so far, samples a second, and whether it ends with the round."""


@contextlib.contextmanager
def _live(options: argparse.Namespace) -> Iterator[_Line]:
    """Show a live line on a terminal, and elsewhere a line a round, on standard error."""
    from rich.console import Console
    from rich.live import Live

    console = Console(stderr=True, highlight=False, markup=False)
    if not console.is_terminal:
        yield _RoundLines(options.tolerance)
        return
    with Live(console=console, transient=True, auto_refresh=False) as live:
        yield _LiveLine(live, options.tolerance)


class _RoundLines(_Line):
    """A line a round."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._report: Report | None = None

    def round(self, report: Report | None) -> None:
        if report is not None and (self._report is None or report.round != self._report.round):
            words = [f"round {report.round}", f"{report.spp:.4g} samples per pixel"]
            words += _seen(report, self._tolerance)
            print(f"vdm-render: {' · '.join(words)}", file=sys.stderr, flush=True)
        self._report = report


class _LiveLine(_Line):
    """One line that changes."""

    def __init__(self, live: Any, tolerance: float) -> None:
        self._live, self._tolerance = live, tolerance
        self._report: Report | None = None
        self._shown = 0.0

    def round(self, report: Report | None) -> None:
        self._report = report

    def part(self, samples: int, speed: float, ending: bool) -> None:
        now = time.monotonic()
        if now - self._shown < LINE_SECONDS:
            return
        self._shown = now
        report = self._report
        words = [f"round {1 if report is None else report.round + 1}"]
        if report is not None:
            words += [f"{samples / report.jnd.size:.4g} samples per pixel"]
            words += _seen(report, self._tolerance)
        words += [f"{speed / 1e6:.2f} million samples/s"]
        if report is not None:
            left = max(report.samples + report.forecast - samples, 0) / speed
            words += [f"{_clock(left)} left"]
        if ending:
            words += ["ending with this round (Ctrl-C again: at once)"]
        self._live.update(" · ".join(words), refresh=True)


def _seen(report: Report, tolerance: float) -> list[str]:
    """Return what a round's decision saw."""
    return [
        f"predicted maximum {report.predicted:.3g} JND",
        f"{100.0 * report.over:.3g} % over {tolerance:g}",
    ]


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def _count(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a whole number over 0, got {text!r}")
    return int(text)


def _seed(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(
            f"expected a whole number from 0 to {2**32 - 1}, got {text!r}"
        )
    return int(text)


def _parameter(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"expected name=value, got {text!r}")
    return name, value
