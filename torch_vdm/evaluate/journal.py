"""Results as they come: a line for each frame and test, safe if killed at any moment."""

import json
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from filelock import FileLock, Timeout

from torch_vdm.io import ImageError

NAME, LOCK = "journal.jsonl", "journal.lock"

# A line's field besides those of a result: CRC-32 of the rest as JSON. A disk may change a digit,
# and the line would still be read.
CHECK = "check"

# Bytes that are searched at once for the end of the last whole line. Status: choice.
BLOCK = 2**16


@dataclass(frozen=True, kw_only=True)
class Result:
    """The result of one frame of one test; a line of the journal.

    Attributes
    ----------
    frame, test
        Their names.
    key
        A hash of the contents of the files, the settings and the version.
    skipped
        Why it could not be compared; empty where it was.
    figures
        By name, as in `torch_vdm.evaluate.figures.FIGURES`; None where one has no value.
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
        A pixel of these pictures stands for a square of so many pixels a side.
    notes
        What was assumed and repaired.
    seconds
        The metric's own time, and the total, including reading and writing.
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


class Journal(Mapping[tuple[str, str], Result]):
    """The journal of an output folder; use it in a ``with`` statement.

    It has the last result of each frame and test, and takes more. A torn last line is ignored, and
    so are lines that are damaged or of another version. Only a result's place in the file is kept
    in memory. While one is open no other can be: two would each have only their own results.

    Raises
    ------
    ImageError
        Where it cannot be written, or another is open.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._places: dict[tuple[str, str], int] = {}
        # The system releases it however the process ends.
        self._lock = FileLock(folder / LOCK)
        try:
            self._lock.acquire(blocking=False)
            _drop_torn_line(self._path)
            self._file = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
            self._lines = self._path.open("rb")
        except Timeout:
            raise ImageError(
                f"{folder}: expected no other evaluation at work there, got one; wait for its end, "
                "or name another folder"
            ) from None
        except OSError as error:
            raise ImageError(
                f"{self._path}: cannot be written: {error.strerror or error}"
            ) from error
        place = 0
        for line in self._lines:
            result = _parsed(line)
            if result is not None:
                self._places[result.frame, result.test] = place
            place += len(line)

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
        self._lines.close()
        self._lock.release()

    def __getitem__(self, key: tuple[str, str]) -> Result:
        """Return the last result of a frame and a test."""
        self._lines.seek(self._places[key])
        result = _parsed(self._lines.readline())
        if result is None:
            raise ImageError(f"{self._path}: was changed by another program; run again")
        return result

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """Return the frames and tests, in the order in which they came first."""
        return iter(self._places)

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._places)

    def add(self, result: Result) -> None:
        """Append a result; it is on the disk when this returns."""
        line = rest = result.line()
        while rest:
            rest = rest[os.write(self._file, rest) :]
        os.fsync(self._file)
        # The current end: nobody else writes, but if somebody did, they would only have appended.
        end = os.lseek(self._file, 0, os.SEEK_CUR)
        self._places[result.frame, result.test] = end - len(line)


class Selection:
    """Results of a journal by their frames and tests, read at each iteration."""

    def __init__(
        self, journal: Mapping[tuple[str, str], Result], keys: Sequence[tuple[str, str]]
    ) -> None:
        self._journal, self._keys = journal, keys

    def __iter__(self) -> Iterator[Result]:
        """Read them one after another."""
        return (self._journal[key] for key in self._keys)


def _parsed(line: bytes) -> Result | None:
    """Return the result of a line; None for a line that is ignored."""
    try:
        fields: Any = json.loads(line)
        check = fields.pop(CHECK)
        return Result(**fields) if check == _checksum(json.dumps(fields)) else None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        return None


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
