"""The command line, ``torch-vdm``."""

import argparse
import contextlib
import errno
import io
import math
import os
import re
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from torch_vdm import __version__
from torch_vdm.cluster import ClusterError
from torch_vdm.evaluate import command as evaluation
from torch_vdm.evaluate.frames import EvaluationError
from torch_vdm.evaluate.judge import Bench
from torch_vdm.io import ImageError, atomic_path, check_target, write_image
from torch_vdm.io.alpha import colour
from torch_vdm.io.refusal import printable
from torch_vdm.loading import Pair, displays_of, load_pairs
from torch_vdm.model.cortex import Haar, StationaryHaar, Steerable, Transform
from torch_vdm.model.display import Display, pixels_per_degree
from torch_vdm.observer import Observer
from torch_vdm.report import Comparison, figures, plain_console, table, write_heat_map
from torch_vdm.run.tiling import SMALLEST_TILE, TILE, whole
from torch_vdm.vdm import VDM

DONE, EXCEEDED, BAD_INPUT, INTERNAL, INTERRUPTED = 0, 1, 2, 3, 130

# Assumed if nothing is given; each is printed. Status: choice. 60 pixels per degree is a
# 27-inch screen of 3840 x 2160 from 0.53 m; 100 cd/m2 is the white of BT.1886 and Display.srgb.
PPD = 60.0
WHITE = 100.0

# Images with more pixels are compared in tiles, unless otherwise requested: whole, one of them
# would take four gigabytes. Status: choice.
LARGEST_WHOLE = 2**24

# How the image is decomposed at each accuracy.
TRANSFORMS: dict[str, Callable[[], Transform]] = {
    "fast": Haar,
    "standard": partial(StationaryHaar, csf="filter"),
    "reference": Steerable,
}

# The default accuracy of each observer; the paper's has the paper's own transform.
ACCURACY = {"calibrated": "standard", "paper": "fast"}

# What must be reported about the fastest.
MAY_MISS = (
    "accuracy fast: at single places, where it meets borders of its nodes, a faint edge may be "
    "missed; --accuracy standard has no such places"
)

OBSERVERS = {"calibrated": Observer.calibrated, "paper": Observer.paper}


class UsageError(ValueError):
    """Options that do not fit together."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and which takes -1e-1 as a number, not an option."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$", re.I)

    def error(self, message: str) -> NoReturn:
        """Print the message and end with status 2."""
        print(f"{self.prog}: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(BAD_INPUT)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``torch-vdm``; return its exit status."""
    return run("torch-vdm", lambda: _command(parsed(_parser(), arguments)))


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """Return the options; help and version are printed, whether or not anybody reads them."""
    try:
        return parser.parse_args(arguments)
    except SystemExit:
        tell("")
        raise


def run(
    program: str,
    command: Callable[[], int],
    refusals: tuple[type[ValueError], ...] = (ImageError, UsageError),
) -> int:
    """Run a command; return its exit status. An error is one line that begins with its name.

    ``command`` returns the status of a run without an error; ``refusals`` are the errors that mean
    bad input. All others are the program's own and give 3, never 1, which says that something was
    exceeded.
    """
    _keep_standard_numbers()
    if isinstance(sys.stdout, io.TextIOWrapper):
        # A file's name may have characters that the terminal lacks.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        return command()
    except refusals as error:  # of the library, one line each
        return _ended(program, str(error), BAD_INPUT)
    except OSError as error:
        if error.errno == errno.ENOMEM:
            return _ended(program, _internal(MemoryError()), INTERNAL)
        return _ended(program, f"{error.filename or 'output'}: {error.strerror}", BAD_INPUT)
    except KeyboardInterrupt:
        return _ended(program, "interrupted", INTERRUPTED)
    except Exception as error:
        return _ended(program, _internal(error), INTERNAL)


def _ended(program: str, why: str, status: int) -> int:
    """Return the status, after one line on standard error if anybody reads that."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            print(f"{program}: {why}", file=sys.stderr)
    return status


def _internal(error: Exception) -> str:
    """Return one line for an error that is not the user's."""
    text = printable(" ".join(str(error).split()))
    # PyTorch reports missing memory in words.
    if isinstance(error, MemoryError) or ("alloc" in text and "memory" in text):
        why = text if isinstance(error, MemoryError) and text else "not enough memory"
        return f"{why}; make the images smaller, or compare in tiles (--tile {TILE})"
    return f"internal error, {type(error).__name__}: {text}; please report it with the images"


def _keep_standard_numbers() -> None:
    """Keep files that are opened later from taking the number of a closed standard stream."""
    number = os.open(os.devnull, os.O_RDWR)
    while number <= 2:
        number = os.open(os.devnull, os.O_RDWR)
    os.close(number)


@contextlib.contextmanager
def _usage() -> Iterator[None]:
    """Treat a value that the model refuses as what it is: an option."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


def _command(options: argparse.Namespace) -> int:
    if options.command == "evaluate":
        return _evaluate(options)
    if options.command == "demo":
        sample = files("torch_vdm") / "sample"
        with as_file(sample / "reference.exr") as one, as_file(sample / "test.exr") as other:
            return _compare(one, other, options)
    return _compare(options.reference, options.test, options)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="torch-vdm",
        description="Tell whether anybody can see the difference between two images, and where.",
    )
    parser.add_argument("--version", action="version", version=f"torch-vdm {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    compare = commands.add_parser(
        "compare",
        help="compare a test image with a reference",
        description="Compare two images of one size in just-noticeable differences: EXR, PNG, "
        "JPEG, HDR, PFM, TIFF, WebP, BMP, PNM, TGA, GIF, AVIF or NPY. Exit status: 0 done, "
        "1 --fail-above exceeded, 2 bad input, 3 internal error or not enough memory.",
    )
    compare.add_argument("reference", type=Path, metavar="REFERENCE")
    compare.add_argument("test", type=Path, metavar="TEST")
    demo = commands.add_parser(
        "demo",
        help="compare a sample pair that ships with the package",
        description="Compare a path-traced picture with its noisy preview: a pair that ships "
        "with the package.",
    )
    for command in (compare, demo):
        _add_options(command)
        _add_output(command, Path("torch-vdm-demo.png") if command is demo else None)
    many = commands.add_parser(
        "evaluate",
        help="compare many frames of several tests, and report",
        description="Compare the frames of one or more tests with those of a reference, and write "
        "a report, tables and maps. Exit status: 0 done, 1 --fail-above exceeded, 2 bad input, "
        "130 interrupted.",
    )
    evaluation.add_arguments(many)
    _add_options(many)
    many.add_argument(
        "--fail-above", type=_jnd, metavar="JND", help="exit with 1 where a maximum is larger"
    )
    return parser


def _add_options(parser: argparse.ArgumentParser) -> None:
    view = parser.add_argument_group("viewing")
    view.add_argument("--ppd", type=positive, metavar="F", help=f"pixels per degree ({PPD:g})")
    view.add_argument(
        "--screen", type=_resolution, metavar="WxH", help="instead of --ppd: the screen's pixels"
    )
    view.add_argument("--diagonal", type=positive, metavar="INCHES", help="its diagonal")
    view.add_argument("--distance", type=positive, metavar="METRES", help="from eye to screen")
    light = parser.add_argument_group("light")
    light.add_argument(
        "--peak",
        type=positive,
        default=WHITE,
        metavar="CD_M2",
        help=f"luminance of white in sRGB-coded files, PNG and JPEG among them ({WHITE:g})",
    )
    light.add_argument(
        "--white",
        type=positive,
        default=WHITE,
        metavar="CD_M2",
        help=f"luminance of 1.0 in files of light, EXR among them ({WHITE:g})",
    )
    light.add_argument(
        "--exposure", type=_stops, default=0.0, metavar="STOPS", help="multiply the light by 2^F"
    )
    model = parser.add_argument_group("model")
    model.add_argument(
        "--accuracy",
        choices=tuple(TRANSFORMS),
        help="fast: the paper's Haar transform, which may miss a faint edge at single places (the "
        "default of --observer paper); standard: its shifts averaged behind a filter, no blocks, "
        "no direction (default); reference: oriented quadrature pairs",
    )
    model.add_argument("--observer", choices=tuple(OBSERVERS), default="calibrated")
    model.add_argument(
        "--effects",
        choices=("auto", "full"),
        default="auto",
        help="auto: what a pair does not call for is not computed, which changes no figure but its "
        "last bits (default); full: all of it is",
    )
    model.add_argument(
        "--tile",
        type=_tile,
        metavar="N",
        help=f"compare in tiles of N x N pixels, for images larger than memory: the same answer; "
        f"{TILE} over {LARGEST_WHOLE / 1e6:.0f} megapixels, below none",
    )
    reading = parser.add_argument_group("reading")
    reading.add_argument(
        "--part",
        metavar="NAME",
        help="part, layer or view of an EXR: a name, its last word, or a number",
    )
    reading.add_argument(
        "--channels",
        type=_channels,
        metavar="R=...,G=...,B=...",
        help="the channels of an EXR to take",
    )
    reading.add_argument(
        "--background",
        type=_background,
        metavar="COLOUR",
        help="behind transparent images: black, white, grey or #rrggbb (black, and white too where "
        "the transparency of the two differs)",
    )
    reading.add_argument(
        "--coded",
        action="store_true",
        help="floating-point values are sRGB-coded, not light",
    )
    reading.add_argument(
        "--nonfinite",
        choices=("raise", "zero", "clamp"),
        default="raise",
        help="NaN and infinity: refused (default); 0; or infinity as the largest value of the "
        "channel's type and NaN as its neighbours' mean",
    )
    reading.add_argument(
        "--negative",
        choices=("raise", "clip", "keep"),
        default="raise",
        help="negative light in the file: refused (default), 0, or kept",
    )


def _add_output(parser: argparse.ArgumentParser, map_path: Path | None) -> None:
    output = parser.add_argument_group("output")
    output.add_argument(
        "--map", type=_map_path, default=map_path, metavar="OUT.png|OUT.exr", help="the heat map"
    )
    output.add_argument("--json", metavar="OUT.json|-", help="the figures; - prints them alone")
    output.add_argument(
        "--fail-above", type=_jnd, metavar="JND", help="exit with 1 where the maximum is larger"
    )


def _evaluate(options: argparse.Namespace) -> int:
    options.accuracy = options.accuracy or ACCURACY[options.observer]
    with _usage():
        options.ppd, seen_from = _viewing(options)
    # Stored as pixels per degree alone: the same view is then the same setting.
    options.screen = options.diagonal = options.distance = None
    assumptions = [seen_from]
    if options.accuracy == "fast" and options.observer == "calibrated":
        assumptions.append(MAY_MISS)
    try:
        outcome = evaluation.run(options, Bench(_pairs, _metric, LARGEST_WHOLE), assumptions)
    except (EvaluationError, ClusterError) as error:
        raise UsageError(str(error)) from error
    tell(outcome.text)
    return EXCEEDED if outcome.exceeded else DONE


def _pairs(
    reference: Path, test: Path, options: argparse.Namespace
) -> tuple[Sequence[Pair], Sequence[str]]:
    return load_pairs(reference, test, displays_of(options), options)


def _metric(display: Display, options: argparse.Namespace) -> VDM:
    transform = TRANSFORMS[options.accuracy]()
    metric = VDM(
        options.ppd, display, OBSERVERS[options.observer](), transform, effects=options.effects
    )
    # A file says what its values are: codes beyond [0, 1] are colours that sRGB lacks.
    metric._range_is_known = True
    return metric


def _compare(reference: Path, test: Path, options: argparse.Namespace) -> int:
    # These hold the maps of large images; one that cannot be removed is not worth a failure.
    with contextlib.ExitStack() as rooms:
        return _compare_with(rooms, reference, test, options)


def _compare_with(
    rooms: contextlib.ExitStack, reference: Path, test: Path, options: argparse.Namespace
) -> int:
    check_outputs((reference, test), (options.map, json_path(options)))
    with _usage():
        options.ppd, seen_from = _viewing(options)
        displays = displays_of(options)
    options.accuracy = options.accuracy or ACCURACY[options.observer]
    pairs, assumptions = load_pairs(reference, test, displays, options)
    with _usage():
        metric = _metric(pairs[0].display, options)
    tile = options.tile
    if tile is None and math.prod(pairs[0].size) > LARGEST_WHOLE:
        tile = TILE
    start = time.perf_counter()
    jnd, pair = _largest(metric, pairs, tile, rooms)
    seconds = time.perf_counter() - start
    plan = metric.plan(whole(pair.test), whole(pair.reference)) if tile is None else None
    luminances = pair.luminances()
    told = figures(jnd)
    assumptions = [seen_from, *assumptions]
    if options.accuracy == "fast" and options.observer == "calibrated":
        assumptions.append(MAY_MISS)
    comparison = Comparison(
        **told,
        score_jnd=told["max_jnd"],
        mean_luminance_change=luminances[1] / luminances[0] - 1.0 if luminances[0] > 0.0 else None,
        width=jnd.shape[1],
        height=jnd.shape[0],
        ppd=options.ppd,
        accuracy=options.accuracy,
        observer=options.observer,
        effects=metric.effects.names(),
        left_out=[] if plan is None else plan.reasons(),
        seconds=seconds,
        assumptions=assumptions,
        version=__version__,
        reproduce=_reproduce(reference, test, tile, options),
    )
    if options.map is not None and options.map.suffix.lower() == ".exr":
        write_image(options.map, jnd)
    elif options.map is not None:
        write_heat_map(options.map, *pair.coded(), jnd, comparison.verdict())
    if options.json == "-":
        tell(comparison.to_json())
    else:
        if options.json is not None:
            with atomic_path(Path(options.json)) as temporary:
                temporary.write_text(comparison.to_json())
        tell(_text(comparison, luminances, options))
    exceeded = options.fail_above is not None and comparison.max_jnd > options.fail_above
    return EXCEEDED if exceeded else DONE


def _largest(
    metric: VDM, pairs: Sequence[Pair], tile: int | None, rooms: contextlib.ExitStack
) -> tuple[Tensor, Pair]:
    """Return the map (H, W) of the pairs' larger difference, and the pair that shows most."""
    maps = [
        _in_tiles(metric, pair, tile, rooms) if tile else _whole(metric, pair) for pair in pairs
    ]
    maxima = [jnd.max().item() for jnd in maps]
    for other in maps[1:]:
        torch.maximum(maps[0], other, out=maps[0])
    return maps[0], pairs[maxima.index(max(maxima))]


def _whole(metric: VDM, pair: Pair) -> Tensor:
    """Return the map (H, W)."""
    with torch.no_grad():
        jnd: Tensor = metric(whole(pair.test), whole(pair.reference))[0, 0]
    return jnd


def _in_tiles(metric: VDM, pair: Pair, tile: int, rooms: contextlib.ExitStack) -> Tensor:
    """Return the same, with a progress bar on a terminal; the map lies in a file."""
    from rich.console import Console
    from rich.progress import Progress

    size = pair.size
    folder = tempfile.TemporaryDirectory(prefix="torch-vdm-", ignore_cleanup_errors=True)
    room = Path(rooms.enter_context(folder))
    jnd = torch.from_file(str(room / "map"), shared=True, size=math.prod(size)).view(1, *size)
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:

        def shown(what: str) -> Callable[[int, int], None]:
            task = bar.add_task(what, total=None)
            return lambda done, steps: bar.update(task, completed=done, total=steps)

        metric.tiled(pair.test, pair.reference, tile, jnd, shown("map"))
    return jnd[0]


def check_outputs(inputs: Sequence[Path], outputs: Sequence[Path | None]) -> None:
    """Refuse, before anything is computed, what could not be written or would destroy an input.

    An output that is None is not wanted.
    """
    taken = {Path(os.path.realpath(path)): path for path in inputs}
    for path in outputs:
        if path is None:
            continue
        target = Path(os.path.realpath(path))
        if target in taken:
            raise UsageError(
                f"{path}: expected a file of its own to write to, got {taken[target]} again; "
                "choose another name"
            )
        check_target(target)
        taken[target] = path


def json_path(options: argparse.Namespace) -> Path | None:
    """Return the file that ``--json`` names; None without one and for standard output."""
    return Path(options.json) if options.json not in (None, "-") else None


def tell(text: str) -> None:
    """Print, and ignore a reader that has closed the stream, or none at all."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes standard output once more at exit: let that go nowhere.
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _viewing(options: argparse.Namespace) -> tuple[float, str]:
    """Return pixels per degree, and in words where they come from."""
    geometry = (options.screen, options.diagonal, options.distance)
    given = [part for part in geometry if part is not None]
    if given and (options.ppd is not None or len(given) < 3):
        raise UsageError(
            "expected --ppd alone, or --screen, --diagonal and --distance together; "
            "give one of the two"
        )
    if given:
        ppd = pixels_per_degree(*geometry)
        return ppd, (
            f"{ppd:.4g} pixels per degree: {options.screen[0]} x {options.screen[1]} pixels on "
            f"{options.diagonal:g} inches from {options.distance:g} m"
        )
    if options.ppd is not None:
        return options.ppd, f"{options.ppd:g} pixels per degree (--ppd)"
    return PPD, f"{PPD:g} pixels per degree, for nothing was given (--ppd)"


def _reproduce(reference: Path, test: Path, tile: int | None, options: argparse.Namespace) -> str:
    """Return the command that gives the same figures, with nothing left to defaults."""
    words = ["torch-vdm", "compare", str(reference), str(test)]
    words += ["--ppd", repr(options.ppd), "--peak", repr(options.peak)]
    words += ["--white", repr(options.white)]
    words += ["--exposure", repr(options.exposure), "--accuracy", options.accuracy]
    words += ["--observer", options.observer, "--effects", options.effects]
    words += ["--nonfinite", options.nonfinite]
    words += ["--negative", options.negative]
    if tile is not None:
        words += ["--tile", str(tile)]
    if options.part is not None:
        words += ["--part", options.part]
    if options.channels is not None:
        words += ["--channels", ",".join(f"{key}={name}" for key, name in options.channels.items())]
    if options.background is not None:
        words += ["--background", options.background]
    if options.coded:
        words.append("--coded")
    return shlex.join(words)


def _text(
    comparison: Comparison, luminances: tuple[float, float], options: argparse.Namespace
) -> str:
    """Return the table, the verdict, what was assumed and what was written."""
    text = io.StringIO()
    console = plain_console(text, 72)
    console.print(table(comparison, luminances))
    console.print(comparison.verdict(), style="bold")
    if options.observer == "paper" and not math.isclose(*luminances, rel_tol=1e-4):
        console.print(
            "The mean luminances differ, and the paper's observer never sees a uniform change; "
            "--observer calibrated does."
        )
    console.print()
    for reason in comparison.left_out:
        console.print(f"left out: {reason}", style="dim")
    for assumption in comparison.assumptions:
        console.print(f"assumed: {assumption}", style="dim")
    for path in (options.map, options.json):
        if path is not None:
            console.print(f"written: {path}", style="dim")
    return text.getvalue()


def _channels(text: str) -> Mapping[str, str]:
    pairs = [part.partition("=") for part in text.split(",")]
    named = {key.strip().upper(): name for key, _, name in pairs}
    if not {"R", "G", "B"} <= set(named) <= {"R", "G", "B", "A"} or "" in named.values():
        raise argparse.ArgumentTypeError(f"expected R=NAME,G=NAME,B=NAME, got {text!r}")
    return named


def _background(text: str) -> str:
    try:
        colour(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text


def number(text: str, what: str, low: float, high: float = math.inf) -> float:
    """Return ``text`` as a finite number over ``low`` and at most ``high``."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (low < value <= high and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"expected {what}, got {text!r}")
    return value


def positive(text: str) -> float:
    """Return ``text`` as a finite number over 0."""
    return number(text, "a number over 0", 0.0)


def _jnd(text: str) -> float:
    return number(text, "a number of JND, 0 or more", -math.ulp(0.0))


def _stops(text: str) -> float:
    return number(text, "a number of stops between -32 and 32", math.nextafter(-32.0, -64.0), 32.0)


def _resolution(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, got {text!r}")
    return int(width), int(height)


def _tile(text: str) -> int:
    if not text.isdecimal() or int(text) < SMALLEST_TILE:
        raise argparse.ArgumentTypeError(
            f"expected a number of pixels, {SMALLEST_TILE} or more, got {text!r}"
        )
    return int(text)


def _map_path(text: str) -> Path:
    path = Path(text)
    if path.suffix.lower() not in (".png", ".exr"):
        raise argparse.ArgumentTypeError(f"expected a file name in .png or .exr, got {text!r}")
    return path
