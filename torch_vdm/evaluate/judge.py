"""One frame of one test: read, judged, written."""

import argparse
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torch_vdm import __version__
from torch_vdm.evaluate import flicker, maps, peers, pictures
from torch_vdm.evaluate.frames import Job
from torch_vdm.evaluate.journal import Result
from torch_vdm.io import write_image
from torch_vdm.io.refusal import printable
from torch_vdm.loading import Pair
from torch_vdm.model.display import BT709_TO_XYZ, Display, decode_srgb, encode_srgb
from torch_vdm.report import figures
from torch_vdm.run.tiling import TILE, Source, whole
from torch_vdm.vdm import VDM

# Where maps, and pictures for the page, lie in the output folder.
MAPS, PICTURES = "maps", "pictures"

# Options that change no figure: where files lie, and how the work is done.
NOT_SETTINGS = (
    "command", "reference", "test", "manifest", "output", "jobs", "resume", "fail_above", "junit",
    "parquet", "scheduler", "tile",
)  # fmt: skip


class Bench(NamedTuple):
    """How a command line reads two files, and by which metric it judges them.

    Attributes
    ----------
    load
        Returns the pairs that two files hold, and what was assumed; a pixel has the largest
        difference over the pairs. Raises a ValueError of one line for files that cannot be
        compared.
    metric
        Returns the metric for a display.
    largest_whole
        Images of more pixels are compared in tiles.
    """

    load: Callable[[Path, Path, argparse.Namespace], tuple[Sequence[Pair], Sequence[str]]]
    metric: Callable[[Display, argparse.Namespace], VDM]
    largest_whole: int


class CannotJudge(Exception):  # noqa: N818 - it gives a reason, the program did not fail
    """A frame that cannot be compared, and why."""


class _Judged(NamedTuple):
    """A map (H, W), the light of the two images (3, H, W), and what was computed."""

    jnd: Tensor
    reference: Tensor
    test: Tensor
    pair: Pair
    metric: VDM
    figures: dict[str, float | None]
    notes: list[str]
    seconds: float


@dataclass
class Judge:
    """Judges jobs one after another; it can be sent to another process.

    Attributes
    ----------
    bench, options
        How to read and to judge.
    output
        The output folder.
    """

    bench: Bench
    options: argparse.Namespace
    output: Path
    _metrics: dict[Display, VDM] = field(default_factory=dict)

    def __call__(self, job: Job, known: Result | None = None) -> Result:
        """Return the result of a job: ``known`` where it is of the same files and settings.

        A frame that cannot be read or compared has a result that says why.

        Raises
        ------
        ImageError
            If the output cannot be written.
        """
        start = time.perf_counter()
        try:
            key = self.key(job)
            if known is not None and known.key == key and self._is_whole(known):
                return known
            judged = self._judged(job)
        except CannotJudge as error:
            return Result(frame=job.frame, test=job.test, skipped=printable(str(error)))
        result = self._written(job, judged)
        seconds = judged.seconds, time.perf_counter() - start
        return replace(result, key=key, seconds=seconds)

    def key(self, job: Job) -> str:
        """Return the hash of everything that the result depends on."""
        contents = [_content(job.reference), _content(job.path)]
        if self.options.flicker and job.before:
            contents += [_content(path) if path.is_file() else "" for path in job.before]
        known = json.dumps([__version__, settings(self.options), *contents])
        return hashlib.sha256(known.encode()).hexdigest()

    def _judged(self, job: Job) -> _Judged:
        """Return all figures of a job."""
        try:
            with torch.no_grad():
                return self._compared(job)
        except MemoryError as error:
            raise CannotJudge(f"{job.path}: not enough memory to compare it") from error
        # Whatever a file makes a reader or the metric raise, the other frames are still compared.
        except Exception as error:
            text = " ".join(str(error).split())
            why = text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}"
            raise CannotJudge(why) from error

    def _compared(self, job: Job) -> _Judged:
        pairs, notes = self.bench.load(job.reference, job.path, self.options)
        metric = self._metric(pairs[0].display)
        start = time.perf_counter()
        found = [self._map(metric, pair.test, pair.reference) for pair in pairs]
        seconds = time.perf_counter() - start
        jnd = torch.stack(found).amax(0) if len(found) > 1 else found[0]
        maxima = [each.max().item() for each in found]
        most = maxima.index(max(maxima))  # the pair with the largest difference
        pair = pairs[most]
        light = _light(pair.reference, pair.display), _light(pair.test, pair.display)
        told = figures(jnd)
        values: dict[str, float | None] = {
            "max_jnd": told["max_jnd"],
            "mean_jnd": told["mean_jnd"],
            "p95_jnd": told["p95_jnd"],
            "visible_fraction": told["visible_fraction"],
        }
        values["mean_luminance_change"] = _luminance_change(*light)
        names = ("psnr", "ssim", *self.options.peers)
        others, failed = peers.judged(names, light[1], light[0], metric.ppd, pair.display.white)
        values |= others
        said = [*notes, *failed]
        if self.options.flicker and job.before:
            values |= self._flicker(job, pairs[most], most, light, said)
        return _Judged(jnd, *light, pair, metric, values, said, seconds)

    def _metric(self, display: Display) -> VDM:
        if display not in self._metrics:
            self._metrics[display] = self.bench.metric(display, self.options)
        return self._metrics[display]

    def _map(self, metric: VDM, test: Source, reference: Source) -> Tensor:
        """Return the map (H, W) of two sources (3, H, W), in tiles where they are large."""
        height, width = test.shape[-2:]
        tile = self.options.tile or (TILE if height * width > self.bench.largest_whole else None)
        if tile:
            return metric.tiled(test, reference, tile)[0]
        jnd: Tensor = metric(whole(test).float(), whole(reference).float())[0, 0]
        return jnd

    def _flicker(
        self,
        job: Job,
        pair: Pair,
        number: int,
        light: tuple[Tensor, Tensor],
        notes: list[str],
    ) -> dict[str, float | None]:
        """Return the figures of flicker of one of a frame's pairs, given by its number.

        A frame before that cannot be read, or is of another kind, is noted.
        """
        assert job.before is not None
        try:
            pairs, _ = self.bench.load(*job.before, self.options)
        except (ValueError, OSError) as error:
            notes.append(f"no flicker: {error}")
            return {}
        earlier = pairs[min(number, len(pairs) - 1)]
        before = [_light(one, earlier.display) for one in (earlier.reference, earlier.test)]
        if before[0].shape != light[0].shape or earlier.display.white != pair.display.white:
            notes.append("no flicker: the frame before is of another size or kind")
            return {}
        metric = self._metric(pair.display)
        expected = flicker.with_error_of_before(*light, *before)
        expected = _pixels(expected, pair.display)
        told = figures(self._map(metric, pair.test, expected))
        return {
            "flicker_max_jnd": told["max_jnd"],
            "flicker_mean_jnd": told["mean_jnd"],
            "flicker_visible_fraction": told["visible_fraction"],
        }

    def _written(self, job: Job, judged: _Judged) -> Result:
        """Write the map and the pictures, and return the result."""
        height, width = judged.jnd.shape
        raw, small = map_paths(self.output, job.frame, job.test)
        folder = self.output / PICTURES
        for needed in (raw.parent, folder):
            needed.mkdir(parents=True, exist_ok=True)
        write_image(raw, judged.jnd)
        pictures.write_thumbnail(small, judged.jnd)
        coded = judged.pair.display.encoding == "srgb" and judged.pair.display.exposure == 0.0
        y, x = divmod(int(judged.jnd.argmax()), width)
        return Result(
            frame=job.frame,
            test=job.test,
            figures=judged.figures,
            size=(width, height),
            max_pixel=(x, y),
            counts=maps.counts(judged.jnd),
            regions=maps.regions(judged.jnd, judged.metric.ppd),
            pictures={
                "reference": pictures.write_image(folder, judged.reference, coded),
                "test": pictures.write_image(folder, judged.test, coded),
                "map": pictures.write_map(folder, judged.jnd),
            },
            block=pictures.block((height, width)),
            notes=[printable(note) for note in judged.notes],
        )

    def _is_whole(self, known: Result) -> bool:
        """Return whether everything that was written with a result is still there."""
        folder = self.output / PICTURES
        files = [pictures.path_of(folder, name) for name in known.pictures.values()]
        files += map_paths(self.output, known.frame, known.test)
        return all(file.is_file() for file in files)


def map_paths(output: Path, frame: str, test: str) -> tuple[Path, Path]:
    """Return the paths of a frame's map and of its thumbnail."""
    folder = output / MAPS / test
    # Not with_suffix: a frame's name may have dots.
    return folder / f"{frame}.exr", folder / f"{frame}.png"


def settings(options: argparse.Namespace) -> dict[str, object]:
    """Return the options on which figures depend."""
    return {
        name: _plain(value)
        for name, value in sorted(vars(options).items())
        if name not in NOT_SETTINGS
    }


def _plain(value: object) -> object:
    """Return an option's value in a form for JSON and for readers."""
    if isinstance(value, list):
        return ",".join(value)
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def _content(path: Path) -> str:
    """Return the hash of a file."""
    if not path.is_file():
        raise CannotJudge(f"{path}: expected a file, got none; check the name")
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CannotJudge(f"{path}: cannot be read: {error.strerror or error}") from error


def _light(source: Source, display: Display) -> Tensor:
    """Return linear light (3, H, W), where 1.0 is white, as the display shows it."""
    pixels = whole(source)[0].float()
    linear = decode_srgb(pixels) if display.encoding == "srgb" else pixels
    return linear.mul(2.0**display.exposure)


def _pixels(light: Tensor, display: Display) -> Tensor:
    """Return the pixel values of light: the inverse of `_light`."""
    linear = light * 2.0**-display.exposure
    return encode_srgb(linear) if display.encoding == "srgb" else linear


def _luminance_change(reference: Tensor, test: Tensor) -> float | None:
    """Return how much brighter the test is, relative; None against a black reference."""
    weights = torch.tensor(BT709_TO_XYZ[1], dtype=torch.float64)
    one, other = (
        (image.mean((1, 2), dtype=torch.float64) * weights).sum().item()
        for image in (reference, test)
    )
    return other / one - 1.0 if one > 0.0 else None
