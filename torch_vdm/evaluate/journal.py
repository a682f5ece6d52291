"""Results as they come: a line for each frame and test, safe from a kill at any moment."""

import json
import os
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from torch_vdm.io import ImageError

NAME = "journal.jsonl"

# What a line has beside a result: CRC-32 of the rest as JSON. A disk may change a digit, and the
# line would still be read.
CHECK = "check"

# Bytes that are looked through at once for the end of the last whole line. Status: choice.
BLOCK = 2**16


@dataclass(frozen=True, kw_only=True)
class Result:
    """What is known of one frame of one test; a line of the journal.

    Attributes
    ----------
    frame, test
        Their names.
    key
        A hash of the contents of the files, the settings and the version.
    skipped
        Why it could not be compared; empty where it was.
    figures
        By name, as in `torch_vdm.evaluate.tables.FIGURES`; None where one has no value.
    size
        Width and height in pixels.
    max_pixel
        x and y of the largest difference.
    counts
        Pixels of the map between the borders `torch_vdm.evaluate.maps.BORDERS`, in order.
    regions
        The worst places: x, y, width, height in pixels, and the largest difference there in JND.
    pictures
        Names of the pictures that the page shows: reference, test and map.
    block
        A pixel of these pictures stands for so many pixels on each side.
    notes
        What was assumed and repaired.
    seconds
        The metric's own time, and the whole, reading and writing too.
    """

    frame: str
    test: str
    key: str = ""
    skipped: str = ""
    figures: dict[str, float | None] = field(default_factory=dict)
    size: tuple[int, int] = (0, 0)
    max_pixel: tuple[int, int] = (0, 0)
    counts: list[int] = field(default_factory=list)
    regions: list[tuple[int, int, int, int, float]] = field(default_factory=list)
    pictures: dict[str, str] = field(default_factory=dict)
    block: int = 1
    notes: list[str] = field(default_factory=list)
    seconds: tuple[float, float] = (0.0, 0.0)

    def line(self) -> bytes:
        """Return the result as JSON on one line, with a checksum of all the rest."""
        fields = asdict(self)
        check = _checksum(json.dumps(fields, allow_nan=False))
        return json.dumps(fields | {CHECK: check}).encode() + b"\n"


class Journal:
    """The journal of an output folder, open for more; use it in a ``with`` statement."""

    def __init__(self, folder: Path) -> None:
        path = folder / NAME
        try:
            _drop_torn_line(path)
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise ImageError(f"{path}: cannot be written: {error.strerror or error}") from error

    def __enter__(self) -> Self:
        """Return the journal."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the file."""
        os.close(self._file)

    def add(self, result: Result) -> None:
        """Append a result; it is on the disk when this returns."""
        line = result.line()
        while line:
            line = line[os.write(self._file, line) :]
        os.fsync(self._file)


def read(folder: Path) -> dict[tuple[str, str], Result]:
    """Return the last result of each frame and test in the journal of a folder.

    A torn last line, and one that was damaged or that another version wrote, count for nothing.
    """
    return {(result.frame, result.test): result for result in _results(folder / NAME)}


def _results(path: Path) -> Iterator[Result]:
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return
    with file:
        for line in file:
            if not line.endswith(b"\n"):
                return
            try:
                fields: Any = json.loads(line)
                check = fields.pop(CHECK)
                result = Result(**fields) if check == _checksum(json.dumps(fields)) else None
            except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
                continue
            if result is not None:
                yield result


def _checksum(text: str) -> int:
    return zlib.crc32(text.encode())


def _drop_torn_line(path: Path) -> None:
    """Cut off what was being written when the last run was killed."""
    if not path.exists():
        return
    with path.open("r+b") as file:
        end = whole = file.seek(0, os.SEEK_END)
        while end > 0:
            begin = max(0, end - BLOCK)
            file.seek(begin)
            newline = file.read(end - begin).rfind(b"\n")
            end = begin
            if newline >= 0:
                end = begin + newline + 1
                break
        if end < whole:
            file.truncate(end)
