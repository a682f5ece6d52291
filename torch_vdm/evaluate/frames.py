"""Which files belong together: frames found by name in folders, by patterns, or in a manifest."""

import csv
import fnmatch
import glob
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from torch_vdm.io.files import SUFFIXES as IMAGES
from torch_vdm.io.refusal import printable

# Suffixes of images in a folder; the content decides the format. `.npy` is read in parts.
SUFFIXES = (*IMAGES, ".npy")

# The columns of a manifest.
COLUMNS = ("frame", "reference", "test", "path")

# Longest part of a name in a manifest, in bytes: file systems take 255, and a suffix is added.
# Status: choice.
LONGEST_PART = 240

# Wildcards as `glob` reads them: a bracket that is not closed within its folder's name is literal.
WILDCARDS = re.compile(r"\*\*/?|\*|\?|\[!?+\]?+[^\]/]*+\]")


class EvaluationError(ValueError):
    """An evaluation that cannot be begun, or that had nothing to compare; one line."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


@dataclass(frozen=True, slots=True)
class Job:
    """One frame of one test, and the files to compare.

    ``before`` holds the reference and the test of the frame before, where it is one of a numbered
    sequence.
    """

    frame: str
    test: str
    reference: Path
    path: Path
    before: tuple[Path, Path] | None = None

    def __str__(self) -> str:
        """Return its name in messages."""
        return f"{self.frame} of {self.test}"


@dataclass(frozen=True, slots=True)
class Missing:
    """A frame of a test that cannot be compared, and why."""

    frame: str
    test: str
    why: str


class Matched(NamedTuple):
    """Tests in the order in which they were given, and the jobs, frame by frame."""

    tests: list[str]
    jobs: list[Job]
    missing: list[Missing]


def match(reference: str, tests: Mapping[str, str], output: Path) -> Matched:
    """Find the frames of a reference and of named tests, each a folder or a pattern.

    Parameters
    ----------
    reference
        A folder, where every image counts, also in subfolders, and a frame is named by its path in
        it without the suffix; or a pattern with ``*``, ``?``, ``[]`` or ``**``, and a frame is
        named by what the wildcards match.
    tests
        The same for each test, by its name.
    output
        A folder whose files are not frames.

    Raises
    ------
    EvaluationError
        If a folder is missing or holds no image, or if a test's name cannot name a folder.
    """
    for test in tests:
        _check_name(test, "a test's name", parts=1)
    references = _found(reference, output)
    found = {test: _found(place, output) for test, place in tests.items()}
    names = set(references).union(*found.values())
    jobs: list[Job] = []
    missing: list[Missing] = []
    for frame in sorted(names, key=natural):
        for test, paths in found.items():
            pair = references.get(frame, []), paths.get(frame, [])
            why = _why_not(frame, *pair)
            if why:
                missing.append(Missing(printable(frame), test, printable(why)))
            else:
                jobs.append(Job(frame, test, pair[0][0], pair[1][0]))
    return Matched(list(tests), _with_predecessors(jobs), missing)


def read_manifest(path: Path) -> Matched:
    """Read what to compare from a file: CSV with a header, or JSON lines (``.jsonl``, ``.json``).

    Each line names a frame, its reference, a test, and the test's file (`COLUMNS`); paths are
    relative to the manifest's folder.

    Raises
    ------
    EvaluationError
        If the manifest cannot be read, lacks a column, names a frame of a test twice, or has a name
        that would be written outside the output folder.
    """
    jobs: dict[tuple[str, str], Job] = {}
    for number, row in _rows(path):
        where = f"{path}, line {number}"
        absent = [name for name in COLUMNS if not isinstance(row.get(name), str) or not row[name]]
        if absent:
            raise EvaluationError(
                f"{where}: expected {', '.join(COLUMNS)}, got no {' and no '.join(absent)}"
            )
        frame, reference, test, file = (str(row[name]) for name in COLUMNS)
        _check_name(frame, f"{where}: a frame's name")
        _check_name(test, f"{where}: a test's name", parts=1)
        if (frame, test) in jobs:
            raise EvaluationError(
                f"{where}: expected each frame of a test once, got {frame} of {test} again"
            )
        jobs[frame, test] = Job(frame, test, path.parent / reference, path.parent / file)
    if not jobs:
        raise EvaluationError(f"{path}: expected a line for each frame and test, got none")
    tests = list(dict.fromkeys(test for _, test in jobs))
    ordered = sorted(jobs.values(), key=lambda job: (natural(job.frame), tests.index(job.test)))
    return Matched(tests, _with_predecessors(ordered), [])


def natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts numbers in names by their value."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part) if number % 2 else 0, part) for number, part in enumerate(parts)]


def _why_not(frame: str, references: Sequence[Path], tests: Sequence[Path]) -> str:
    """Return why a frame cannot be compared; empty where it can."""
    for paths, what in ((references, "the reference"), (tests, "the test")):
        if not paths:
            return f"missing in {what}"
        if len(paths) > 1:
            files = " and ".join(path.name for path in paths)
            return f"{what} has several files of this name, {files}; keep one"
    return "" if _fits(frame) else "its name cannot be the name of a file everywhere; rename it"


def _found(place: str, output: Path) -> dict[str, list[Path]]:
    """Return the images of a folder or a pattern by the name of their frame."""
    folder = Path(place)
    named: Iterable[tuple[str, Path]]
    if folder.is_dir():
        files = (path for path in folder.rglob("*") if not _hidden(path.relative_to(folder)))
        named = ((path.relative_to(folder).with_suffix("").as_posix(), path) for path in files)
    elif WILDCARDS.search(place):
        named = _by_pattern(place)
    elif folder.is_file():
        raise EvaluationError(
            f"{place}: expected a folder or a pattern, got a file; name its folder, or compare two "
            "files with torch-vdm compare"
        )
    else:
        raise EvaluationError(
            f"{place}: expected a folder, or a pattern such as '{place}/*.exr', got neither; "
            "check the name"
        )
    inside = output.resolve()
    if inside in (folder.resolve(), *folder.resolve().parents):
        raise EvaluationError(
            f"{place}: expected images outside the output folder, got those in {output}, which "
            "holds results; name another --output"
        )
    frames: dict[str, list[Path]] = {}
    for name, path in sorted(named):
        is_image = path.suffix.lower() in SUFFIXES and path.is_file()
        if is_image and inside not in path.resolve().parents:
            frames.setdefault(name, []).append(path)
    if not frames:
        raise EvaluationError(f"{place}: expected images ({', '.join(SUFFIXES)}), got none")
    return frames


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _by_pattern(pattern: str) -> Iterator[tuple[str, Path]]:
    """Yield the files of a pattern, named by what its wildcards match, without the suffix."""
    pattern = Path(pattern).as_posix()
    without_suffix = re.sub(r"\.[^./]*$", "", pattern)
    expressions = [_expression(each) for each in (without_suffix, pattern)]
    for found in glob.glob(pattern, recursive=True):  # noqa: PTH207 - Path.glob needs a root
        path = Path(found)
        if not path.name:  # the root folder
            continue
        stem = path.with_suffix("").as_posix()
        # A wildcard may match a part of the suffix too, as in '*exr'.
        for (expression, joints), name in (
            (expressions[0], stem),
            (expressions[1], stem),
            (expressions[1], path.as_posix()),
        ):
            matched = expression.fullmatch(name)
            if matched:
                yield _joined(joints, matched.groups()), path
                break


def _expression(pattern: str) -> tuple[re.Pattern[str], list[str]]:
    """Return an expression with a group for each wildcard, and what joins each to those before."""
    expression, joints, end = "", [], 0
    for wildcard in WILDCARDS.finditer(pattern):
        literal = pattern[end : wildcard.start()]
        joints.append("/" if "/" in literal else "-")
        expression += re.escape(literal) + _group(wildcard.group())
        end = wildcard.end()
    return re.compile(expression + re.escape(pattern[end:]), re.DOTALL), joints


def _joined(joints: Iterable[str], parts: Iterable[str | None]) -> str:
    name = ""
    for joint, part in zip(joints, parts, strict=True):
        if part:
            name += (joint if name and not name.endswith("/") else "") + part
    return name.strip("/")


def _group(wildcard: str) -> str:
    """Return a wildcard as a group of a regular expression."""
    if wildcard.startswith("**"):
        return "(.*/)?" if wildcard.endswith("/") else "(.*)"
    if wildcard.startswith("["):
        # The expression that `glob` uses, without what surrounds it: (?s:...) and the text's end.
        return f"({fnmatch.translate(wildcard)[4:-3]})"
    return "([^/]*)" if wildcard == "*" else "([^/])"


def _rows(path: Path) -> Iterator[tuple[int, Mapping[str, object]]]:
    """Yield the lines of a manifest with their numbers."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            if path.suffix.lower() in (".jsonl", ".json", ".ndjson"):
                for number, line in enumerate(file, 1):
                    if line.strip():
                        yield number, _object(line, f"{path}, line {number}")
            else:
                reader = csv.DictReader(file, strict=True)
                for row in reader:
                    yield reader.line_num, row
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise EvaluationError(f"{path}: expected CSV or JSON lines in UTF-8: {error}") from error


def _object(line: str, where: str) -> Mapping[str, object]:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise EvaluationError(f"{where}: expected a JSON object, got {line[:40]!r}") from error
    if not isinstance(row, dict):
        raise EvaluationError(f"{where}: expected a JSON object, got {line[:40]!r}")
    return row


def _check_name(name: str, what: str, parts: int | None = None) -> None:
    """Refuse a name that would be written outside the output folder, or cannot be written."""
    if not _fits(name) or (parts is not None and name.count("/") >= parts):
        kind = "a word" if parts == 1 else "a relative path without '..'"
        raise EvaluationError(f"{what}: expected {kind} to write a file under, got {name[:80]!r}")


def _fits(name: str) -> bool:
    """Return whether a file may be written under a name, below a folder, on every system."""
    parts = name.split("/")
    return (
        all(part not in ("", ".", "..") for part in parts)
        and "\\" not in name
        and ":" not in parts[0][:2]
        and name.isprintable()  # half a surrogate pair, which has no bytes, is not
        and all(len(part.encode()) <= LONGEST_PART for part in parts)
    )


def _with_predecessors(jobs: Iterable[Job]) -> list[Job]:
    """Return the jobs, those of numbered sequences with the frame before."""
    jobs = list(jobs)
    files: dict[tuple[str, str, int, str], tuple[Path, Path]] = {}
    for job in jobs:
        numbered = _numbered(job.frame)
        if numbered:
            files[job.test, *numbered] = job.reference, job.path

    def before(job: Job) -> tuple[Path, Path] | None:
        numbered = _numbered(job.frame)
        if not numbered:
            return None
        head, number, tail = numbered
        return files.get((job.test, head, number - 1, tail))

    return [Job(job.frame, job.test, job.reference, job.path, before(job)) for job in jobs]


def _numbered(frame: str) -> tuple[str, int, str] | None:
    """Return what stands before the last number in a name, the number, and what stands after."""
    found = re.fullmatch(r"(.*?)([0-9]{1,18})([^0-9]*)", frame, re.DOTALL)
    return (found[1], int(found[2]), found[3]) if found else None
