"""Many scenes, or many frames of them, rendered by a Dask cluster: a picture is the unit of work.

A picture and its figures lie side by side as ``NAME.exr`` and ``NAME.json``. The latter has a hash
of the scene's files, the settings and the versions: where it is the same, the picture is kept and
not rendered again. While a picture is rendered there is also a checkpoint, from which another
worker continues when one dies.
"""

import argparse
import contextlib
import hashlib
import io
import json
import sys
import threading
from collections import Counter
from collections.abc import Callable
from functools import partial
from itertools import count, takewhile
from pathlib import Path
from typing import Any, NamedTuple

from sampling.checkpoint import CheckpointError, partial_of
from sampling.renderers.mitsuba import MitsubaRenderer, SceneError, preserved
from torch_vdm import __version__
from torch_vdm.cluster import LOCAL, ClusterError, answers, check, work
from torch_vdm.io import ImageError, atomic_path, check_target, remove_abandoned
from torch_vdm.io.refusal import printable
from torch_vdm.report import progress

# The scene's parameter that receives the frame number, and the digits of that number in a name.
FRAME, DIGITS = "frame", 4

# The JSON file that marks an output folder and holds its settings; no picture's file can have
# this name.
NAME = "vdm-render.run"

# Workers on this machine: while one decides, on a single processor, the other renders, on all.
# Status: choice.
HERE = 2

# Failed pictures whose reason is printed; --json has all. Status: choice.
NAMED = 5

# Options that change no picture.
NOT_SETTINGS = (
    "scenes", "scene", "output", "frames", "scheduler", "jobs", "checkpoint", "resume", "json",
    "parameters",
)  # fmt: skip

# Renders one picture by its options, writes it, and returns the figures of each view.
Views = Callable[[argparse.Namespace], list[dict[str, Any]]]

# Mitsuba, the number of threads and standard error belong to the process, not to a thread.
_one = threading.Lock()


class Picture(NamedTuple):
    """A scene, or a frame of it."""

    scene: Path
    frame: int | None

    def __str__(self) -> str:
        """Return its name in messages."""
        return f"{self.scene}" + ("" if self.frame is None else f", frame {self.frame}")

    @property
    def name(self) -> str:
        """Return the name of its file."""
        number = "" if self.frame is None else f".{self.frame:0{DIGITS}}"
        return f"{self.scene.stem}{number}.exr"


class Done(NamedTuple):
    """The outcome of a picture: the figures of each of its views, or why there are none."""

    views: list[dict[str, Any]]
    failed: str = ""
    warnings: tuple[str, ...] = ()
    stood: bool = False


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose many pictures and what renders them."""
    many = parser.add_argument_group(
        "many pictures", "several scenes, or frames: --output is then a folder"
    )
    many.add_argument(
        "--frames",
        type=_frames,
        metavar="FIRST-LAST",
        help=f"render each scene for each of these numbers, as its parameter {FRAME!r}",
    )
    many.add_argument(
        "--scheduler",
        metavar="ADDRESS|FILE|local",
        help="share them among the workers of a Dask scheduler: its address, tcp://host:8786, or "
        f"its scheduler file; 'local' starts one with --jobs workers on this machine ({LOCAL})",
    )
    many.add_argument(
        "--jobs", type=_positive, metavar="N", help=f"workers on this machine ({HERE})"
    )


def are_many(options: argparse.Namespace) -> bool:
    """Return whether many pictures are asked for, or one that a cluster is to render."""
    return bool(
        len(options.scenes) > 1
        or options.frames is not None
        or options.scheduler is not None
        or options.jobs
    )


def render_all(options: argparse.Namespace, views: Views) -> tuple[str, bool]:
    """Render all pictures on the workers and write them into the output folder.

    One that cannot be rendered is reported and counted, and the others are still rendered.

    Parameters
    ----------
    options
        The command's options.
    views
        Renders one picture; workers look it up by name.

    Returns
    -------
    tuple
        The summary of all pictures, and whether any of them failed.

    Raises
    ------
    ClusterError
        If the options do not fit together, or the scheduler or a worker cannot be used.
    ImageError
        If the output cannot be written.
    """
    scheduler = options.scheduler or LOCAL
    check(scheduler, options.jobs)
    pictures = _pictures(options)
    _prepare(options, pictures)
    folder: Path = options.output.absolute()
    sent = work(partial(_done, views), folder / NAME)
    workers = min(options.jobs or HERE, len(pictures))
    told = partial(_told, options, folder)
    total = _Sum()
    failed: dict[Picture, str] = {}
    images = {folder / picture.name for picture in pictures}
    with (
        contextlib.closing(answers(sent, pictures, told, scheduler, workers)) as coming,
        progress("rendering", len(pictures)) as advance,
    ):
        said = sys.stderr  # before a worker in this process redirects it
        try:
            for picture, done in coming:
                done = done or Done(
                    [],
                    f"{picture.scene}: every worker that rendered it died; "
                    "give the workers more memory",
                )
                for warning in done.warnings:
                    print(f"vdm-render: warning: {picture}: {warning}", file=said)
                if done.failed:
                    failed[picture] = done.failed
                    if len(failed) <= NAMED:
                        number = "" if picture.frame is None else f"frame {picture.frame}: "
                        print(f"vdm-render: {number}{done.failed}", file=said)
                total.add(picture, done)
                images |= {folder / Path(view["written"][0]).name for view in done.views}
                advance()
        except KeyboardInterrupt:
            print(
                f"vdm-render: what is done is kept in {options.output}; --resume goes on",
                file=said,
            )
            raise
    _clear(images)
    text = total.text(options.output)
    if options.json == "-":
        text = _all(folder, pictures, failed)
    elif options.json is not None:
        with atomic_path(Path(options.json)) as temporary:
            temporary.write_text(_all(folder, pictures, failed))
    return text, bool(failed)


def _clear(images: set[Path]) -> None:
    """Remove what workers that were killed left half-written of pictures."""
    remove_abandoned([*images, *(image.with_suffix(".json") for image in images)])
    for image in images:
        partial_of(image.with_suffix(".checkpoint")).unlink(missing_ok=True)


class _Sum:
    """The summary of all pictures, from a few numbers of each."""

    def __init__(self) -> None:
        self._ended: Counter[str] = Counter()
        self._rendered = self._stood = self._failed = self._samples = 0
        self._worst: tuple[float, str] = (0.0, "")

    def add(self, picture: Picture, done: Done) -> None:
        self._failed += bool(done.failed)
        self._stood += done.stood
        self._rendered += not (done.failed or done.stood)
        for figures in done.views:
            self._ended[figures["stop_reason"]] += 1
            self._samples += figures["samples_total"]
            # Infinity comes back from a JSON file as None.
            largest = figures["predicted_max_jnd"]
            if largest is not None:
                self._worst = max(self._worst, (largest, str(picture)))

    def text(self, output: Path) -> str:
        lines = [f"{self._rendered} rendered, {self._stood} done before, {self._failed} failed."]
        if self._ended:
            ends = ", ".join(f"{reason} {count}" for reason, count in sorted(self._ended.items()))
            lines.append(f"ended by: {ends}; {self._samples:.4g} samples in all")
        if self._worst[1]:
            lines.append(f"largest prediction: {self._worst[0]:.3g} JND, {self._worst[1]}")
        return "\n".join([*lines, f"written: {output}"]) + "\n"


def _pictures(options: argparse.Namespace) -> list[Picture]:
    """Return the pictures to render, each with a name of its own."""
    frames = [None] if options.frames is None else options.frames
    pictures = [Picture(scene, frame) for scene in options.scenes for frame in frames]
    named: dict[str, Picture] = {}
    for picture in pictures:
        other = named.setdefault(picture.name, picture)
        if other is not picture:
            raise ClusterError(
                f"expected scenes of different names, got {other} and {picture}, which would both "
                f"be written to {picture.name}; rename one, or give each a run of its own"
            )
    if options.frames is not None and any(name == FRAME for name, _ in options.parameters):
        raise ClusterError(f"expected --frames or -D {FRAME}=..., got both; leave one out")
    return pictures


def _prepare(options: argparse.Namespace, pictures: list[Picture]) -> None:
    """Make the output folder, unless one with results is in the way."""
    output: Path = options.output
    if options.checkpoint is not None:
        raise ClusterError(
            "expected no --checkpoint with many pictures, each of which has its own; leave it out"
        )
    if options.json not in (None, "-"):
        check_target(Path(options.json))
    if output.exists() and not output.is_dir():
        raise ClusterError(f"{output}: expected a folder for many pictures, got a file")
    if not options.resume:
        there = [name for name in (NAME, pictures[0].name) if (output / name).exists()]
        if there:
            raise ClusterError(
                f"{output}: expected a folder without pictures, got one with {there[0]}; go on "
                "with --resume, or name another"
            )
    output.mkdir(parents=True, exist_ok=True)
    with atomic_path(output / NAME) as temporary:
        told = {"version": __version__, "scenes": [str(scene) for scene in options.scenes]}
        temporary.write_text(json.dumps(told | _settings(options), indent=1) + "\n")


def _told(options: argparse.Namespace, folder: Path, picture: Picture) -> tuple[argparse.Namespace]:
    """Return the options of one picture, valid from any folder."""
    own = argparse.Namespace(**vars(options))
    own.scene, own.output, own.json = picture.scene.absolute(), folder / picture.name, None
    own.checkpoint = own.output.with_suffix(".checkpoint")
    if picture.frame is not None:
        own.parameters = [*options.parameters, (FRAME, str(picture.frame))]
    own.scenes = own.frames = None
    return (own,)


def _done(views: Views, options: argparse.Namespace) -> Done:
    """Render a picture on a worker, unless it is already there."""
    with _one, contextlib.redirect_stderr(io.StringIO()) as said:
        try:
            done = _rendered(views, options)
        except SceneError as error:
            return Done([], str(error))
        except (ImageError, ClusterError):
            raise
        except ValueError as error:  # bad settings, or a checkpoint that cannot be written
            raise ClusterError(str(error)) from error
        except (RuntimeError, MemoryError) as error:  # from Mitsuba, on this scene
            return Done([], f"{type(error).__name__}: {printable(str(error)).strip()}")
    mark = "warning: "
    warned = (line.partition(mark)[2] for line in said.getvalue().splitlines() if mark in line)
    return done._replace(warnings=tuple(printable(line) for line in warned))


def _rendered(views: Views, options: argparse.Namespace) -> Done:
    record = options.output.with_suffix(".json")
    known = _known(record, options)
    if known is not None:
        # A worker may have died between writing the record and deleting the checkpoint.
        _delete_kept(options)
        return Done(known, stood=True)
    # It belongs to another picture, which this one overwrites.
    record.unlink(missing_ok=True)
    kept = _kept(options)
    options.resume = bool(kept)
    try:
        told = views(options)
    except CheckpointError:
        if not kept:
            raise
        # It has other settings, or two workers wrote it at once.
        _delete_kept(options)
        options.resume = False
        told = views(options)
    for figures in told:
        figures["written"] = figures["written"][:1]  # its checkpoint is deleted
    key = _key(options, *(told[0][name] for name in ("mitsuba", "variant", "fingerprint")))
    with atomic_path(record) as temporary:
        temporary.write_text(json.dumps({"key": key, "views": told}, indent=1) + "\n")
    _delete_kept(options)
    return Done(told)


def _key(options: argparse.Namespace, mitsuba: str, variant: str, fingerprint: str) -> str:
    """Return the hash of all that a picture depends on; ``fingerprint`` is its scene's."""
    told = json.dumps([__version__, mitsuba, variant, fingerprint, _settings(options)])
    return hashlib.sha256(told.encode()).hexdigest()


def _settings(options: argparse.Namespace) -> dict[str, object]:
    """Return the options on which pictures depend, except the scene and its parameters."""
    return {
        name: value for name, value in sorted(vars(options).items()) if name not in NOT_SETTINGS
    }


def _known(record: Path, options: argparse.Namespace) -> list[dict[str, Any]] | None:
    """Return the figures of an existing picture of this scene with these settings."""
    try:
        told = json.loads(record.read_text())
        views: list[dict[str, Any]] = told["views"]
        # By name only, because the folder may have been moved.
        files = [record.with_name(Path(figures["written"][0]).name) for figures in views]
        key: str = told["key"]
    except (OSError, ValueError, LookupError, TypeError):
        return None
    if not all(path.is_file() for path in files):
        return None
    with preserved():
        scene = MitsubaRenderer(
            options.scene, dict(options.parameters), filter=options.filter, variant=options.variant
        )
    return views if key == _key(options, scene.version, scene.variant, scene.fingerprint) else None


def _kept(options: argparse.Namespace) -> list[Path]:
    """Return the existing checkpoints of a picture: of its view, or of all its views by number."""
    checkpoint: Path = options.checkpoint
    if options.sensor != "all":  # numbered ones belong to a scene with such a name
        return [checkpoint] if checkpoint.is_file() else []
    names = (f"{checkpoint.stem}.{number}{checkpoint.suffix}" for number in count())
    views = takewhile(Path.is_file, map(checkpoint.with_name, names))
    return [path for path in (checkpoint, *views) if path.is_file()]


def _delete_kept(options: argparse.Namespace) -> None:
    for path in _kept(options):
        path.unlink(missing_ok=True)


def _all(folder: Path, pictures: list[Picture], failed: dict[Picture, str]) -> str:
    """Return the figures of all pictures as JSON: for each, in order, a list of its views."""
    told: list[object] = []
    for picture in pictures:
        if picture in failed:
            told.append([{"scene": str(picture.scene), "failed": failed[picture]}])
        else:
            record = (folder / picture.name).with_suffix(".json")
            told.append(json.loads(record.read_text())["views"])
    return json.dumps(told, indent=1) + "\n"


def _frames(text: str) -> range:
    first, _, last = text.partition("-")
    ends = first, last or first
    if not all(end.isascii() and end.isdecimal() for end in ends) or int(ends[0]) > int(ends[1]):
        raise argparse.ArgumentTypeError(f"expected FIRST-LAST, such as 1-240, got {text!r}")
    return range(int(ends[0]), int(ends[1]) + 1)


def _positive(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"expected a number of workers, got {text!r}")
    return int(text)
