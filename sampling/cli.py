"""The command line, ``vdm-render``: render a scene until nobody sees what is still missing."""

import argparse
import contextlib
import json
import shlex
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

from sampling import cluster
from sampling.renderers.filter import FILTERS, SCENE
from sampling.renderers.mitsuba import VARIANTS
from sampling.rendering import EFFECTS, FEW_PIXELS, Result, Watch, render, seen, terminal
from sampling.sampler import Report
from sampling.strategies import STRATEGIES
from torch_vdm import __version__
from torch_vdm.cli import (
    BAD_INPUT,
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
from torch_vdm.io import atomic_path

# The value of --sensor for every sensor of the scene.
ALL = "all"


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
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE.xml")
    parser.add_argument("--output", type=Path, required=True, metavar="OUT.exr|DIR")
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
    scene.add_argument(
        "--effects",
        choices=EFFECTS,
        default=EFFECTS[0],
        help="auto: leave out what nobody could see; full: nothing (auto)",
    )
    scene.add_argument(
        "--aov",
        action="store_true",
        help="write albedo, shading normal and depth, from the same rays",
    )
    scene.add_argument(
        "--sensor",
        type=_sensor,
        default=0,
        metavar="N|ID|all",
        help="number from 0 on, or id; all: each, to OUT.0.exr, OUT.1.exr and so on (0)",
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
    cluster.add_arguments(parser)
    return parser


class _Console(Watch):
    """Prints a line per round where there is no terminal, and counts Ctrl-C.

    The first Ctrl-C ends the run after its round, the second at once. A request to terminate, as
    a cluster's scheduler sends it, ends it at once too. The result so far is still written whole;
    a third Ctrl-C gives that up. Before rendering begins, Ctrl-C works as usual.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._silent: bool = terminal().is_terminal
        self._told = 0
        self._count = 0
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> "_Console":
        return self

    def __exit__(self, *_: object) -> None:
        for kind, handler in self._before.items():
            signal.signal(kind, handler)

    def begin(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return  # a cluster's worker, which handles signals itself
        kinds = signal.SIGINT, signal.SIGTERM
        self._before = {kind: signal.signal(kind, self._note) for kind in kinds}

    def presses(self) -> int:
        return self._count

    def round(self, report: Report | None) -> None:
        # A continued run has already reported its earlier rounds.
        if report is not None and report.round != self._told and not self._silent:
            words = [f"round {report.round}", f"{report.spp:.4g} samples per pixel"]
            words += seen(report, self._tolerance)
            print(f"vdm-render: {' · '.join(words)}", file=sys.stderr, flush=True)
            self._told = report.round

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._count = max(2, self._count) if number == signal.SIGTERM else self._count + 1
        if self._count >= 3:
            signal.default_int_handler(number, frame)


def _run(options: argparse.Namespace, words: list[str]) -> int:
    if cluster.are_many(options):
        text, failed = cluster.render_all(options, _views)
        tell(text)
        return BAD_INPUT if failed else DONE
    (options.scene,) = options.scenes
    told = _views(options)
    every = options.sensor == ALL
    if options.json is not None:
        text = json.dumps(told if every else told[0], indent=2) + "\n"
        if options.json == "-":
            tell(text)
        else:
            with atomic_path(Path(options.json)) as temporary:
                temporary.write_text(text)
    if options.json != "-":
        tell("\n".join(_text(figures, options) for figures in told))
    if told[-1]["stop_reason"] != "interrupted":
        return DONE
    again = [word for word in words if word != "--resume"]
    if options.checkpoint is None:
        again += ["--checkpoint", str(_kept(options))]
    print(
        f"vdm-render: interrupted; go on with: {shlex.join(['vdm-render', *again, '--resume'])}",
        file=sys.stderr,
    )
    return INTERRUPTED


def _views(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Render one view, or all views of the scene; return the figures of each."""
    every = options.sensor == ALL
    sensors: list[int | str] = [0 if every else options.sensor]
    told: list[dict[str, Any]] = []
    while len(told) < len(sensors):
        number = len(told)
        result = _rendered(options, sensors[number], number if every else None)
        if every:
            sensors = list(range(result.figures["sensors"]))
        told.append(result.figures)
        if result.stop_reason == "interrupted":
            break
    return told


def _rendered(options: argparse.Namespace, sensor: int | str, number: int | None) -> Result:
    """Render one view and write what was asked for; ``number`` counts those of all sensors."""
    output, kept = _numbered(options.output, number), _numbered(_kept(options), number)
    checkpoint = kept if options.checkpoint else None
    if output.suffix.lower() != ".exr":
        raise UsageError(f"{output}: expected a name that ends in .exr")
    # Before anything is rendered, refuse what could not be written or would destroy an input.
    check_outputs((options.scene,), (output, checkpoint, json_path(options)))
    with _warned(), _Console(options.tolerance) as console:
        result = render(
            options.scene,
            options.tolerance,
            options.ppd,
            options.white,
            sensor,
            options.seed,
            options.filter,
            effects=options.effects,
            observer=OBSERVERS[options.observer](),
            strategy=options.strategy,
            max_spp=options.max_spp,
            time_limit=options.time_limit,
            noise_threshold=options.noise_threshold,
            unbiased=options.unbiased,
            aov=options.aov,
            parameters=dict(options.parameters),
            variant=options.variant,
            checkpoint=checkpoint,
            resume=kept if options.resume else None,
            watch=console,
        )
        result.save(output)
        if result.stop_reason == "interrupted" and checkpoint is None:
            result.save_checkpoint(kept)
    result.figures["scene"] = str(options.scene)
    result.figures["written"] = [str(path) for path in (output, checkpoint) if path is not None]
    result.figures["reproduce"] = _reproduce(options, result.figures)
    return result


def _kept(options: argparse.Namespace) -> Path:
    """Return the path of the run's checkpoint, if there is one."""
    kept: Path = options.checkpoint or options.output.with_name(f"{options.output.name}.checkpoint")
    return kept


def _numbered(path: Path, number: int | None) -> Path:
    """Return the path with a number before its suffix; unchanged without a number."""
    return path if number is None else path.with_name(f"{path.stem}.{number}{path.suffix}")


@contextlib.contextmanager
def _warned() -> Iterator[None]:
    """Print the renderer's warnings as lines of the program, without deprecation warnings."""

    def line(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        if category is UserWarning:
            print(f"vdm-render: warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = line
        yield


def _reproduce(options: argparse.Namespace, figures: dict[str, Any]) -> str:
    """Return the command that gives the same image, with nothing left to defaults."""
    words = ["vdm-render", str(options.scene), "--output", str(options.output)]
    if figures["width"] * figures["height"] >= FEW_PIXELS:  # the last bits depend on it
        words = [f"OMP_NUM_THREADS={figures['threads']}", *words]
    for name in ("strategy", "tolerance", "max_spp", "time_limit", "noise_threshold", "seed"):
        value = getattr(options, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", str(value)]
    for name in ("ppd", "white", "observer", "effects", "sensor", "filter", "variant"):
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
    """Return in words how the run ended, its cost, what was assumed and what was written."""
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
    if figures["black"]:
        lines.append(
            "black: no sample has met any light; look at the scene's lights and at what its "
            "sensor sees"
        )
    elif figures["grey"]:
        lines.append("grey: all samples are, so that decisions took one plane in place of three")
    plan = figures["plan"]
    depth = "no limit of depth" if plan["max_depth"] is None else f"depth {plan['max_depth']}"
    simulated = [each["effect"] for each in plan["effects"] if each["simulated"]]
    if figures["sensors"] > 1:
        lines.append(f"seen by: sensor {plan['sensor']} (--sensor)")
    lines += [
        f"simulated: {plan['integrator']}, {depth}, {figures['variant']}, "
        f"{plan['pixel_filter']} filter" + "".join(f", {effect}" for effect in simulated),
        *(
            f"{what}: {each}"
            for what in ("left out", "kept")
            for each in plan[what.replace(" ", "_")]
        ),
        f"assumed: {options.ppd:g} pixels per degree (--ppd)",
        f"assumed: 1.0 is {options.white:g} cd/m2 (--white)",
        f"assumed: the {options.observer} observer (--observer)",
    ]
    lines += [f"written: {path}" for path in figures["written"]]
    lines += [f"written: {options.json}"] * (options.json is not None)
    return "\n".join(lines) + "\n"


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


def _sensor(text: str) -> int | str:
    return int(text) if text.isascii() and text.isdecimal() else text


def _parameter(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"expected name=value, got {text!r}")
    return name, value
