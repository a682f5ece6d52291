"""Manifests, patterns, names and journals damaged anywhere: told in one line, or survived."""

import glob
import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from torch_vdm.evaluate.frames import (
    COLUMNS,
    SUFFIXES,
    EvaluationError,
    Matched,
    match,
    read_manifest,
)
from torch_vdm.evaluate.journal import NAME, Journal, Result

# The same examples each time; none is kept between runs. A folder is made for each.
law = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)

# Where a file is damaged, and how: cut off there, or some bytes written over.
damage = st.tuples(st.integers(0, 2000), st.none() | st.binary(min_size=1, max_size=4))

# Whatever a name may hold that JSON or CSV can tell, half a surrogate pair too.
names = st.text(st.characters(), min_size=1, max_size=12)


def damaged(content: bytes, how: tuple[int, bytes | None]) -> bytes:
    """Return content that is cut off, or that has other bytes at a place."""
    place, written = how[0] % (len(content) + 1), how[1]
    if written is None:
        return content[:place]
    return content[:place] + written + content[place + len(written) :]


@contextmanager
def folder() -> Iterator[Path]:
    """Make a folder for one example."""
    place = Path(tempfile.mkdtemp())
    try:
        yield place
    finally:
        shutil.rmtree(place)


def check_matched(found: Matched) -> None:
    """Check what all code behind relies on: each frame of a test once, under a safe name."""
    keys = [(each.frame, each.test) for each in found.jobs]
    keys += [(each.frame, each.test) for each in found.missing]
    assert len(keys) == len(set(keys))
    assert {test for _, test in keys} <= set(found.tests)
    out = Path("/out/maps")
    for job in found.jobs:
        written = out / job.test / f"{job.frame}.exr"
        assert ".." not in written.parts
        assert written.is_relative_to(out / job.test)
        assert written.as_posix().isprintable()


def check_told(error: EvaluationError, of: str) -> None:
    """Check that an error is a line that says which file."""
    assert str(error).isprintable()
    assert of in str(error)


ROWS = [
    {
        "frame": f"hall/{number:02}",
        "reference": f"r/{number}.exr",
        "test": test,
        "path": f"{test}/é.exr",
    }
    for number in range(4)
    for test in ("old", "new")
]
JSON_LINES = "".join(json.dumps(row) + "\n" for row in ROWS).encode()
CSV = "".join(
    ",".join(row) + "\r\n" for row in (COLUMNS, *(each.values() for each in ROWS))
).encode()


@pytest.mark.parametrize(("name", "content"), [("m.csv", CSV), ("m.jsonl", JSON_LINES)])
def test_a_whole_manifest_is_read(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    found = read_manifest(tmp_path / name)
    assert len(found.jobs) == len(ROWS)
    check_matched(found)


@pytest.mark.parametrize(("name", "content"), [("m.csv", CSV), ("m.jsonl", JSON_LINES)])
def test_a_manifest_that_is_cut_off_anywhere(tmp_path: Path, name: str, content: bytes) -> None:
    whole = read_whole(tmp_path / name, content)
    for place in range(len(content)):
        (tmp_path / name).write_bytes(content[:place])
        try:
            found = read_manifest(tmp_path / name)
        except EvaluationError as error:
            check_told(error, name)
        else:
            check_matched(found)
            # What is read is what stands there: the last line's path may be cut short, no other.
            keys = [(job.frame, job.test) for job in found.jobs]
            assert len(keys) <= content[:place].count(b"\n") + 1
            wrong = [job for job in found.jobs if job.path != whole[job.frame, job.test]]
            assert len(wrong) <= 1


def read_whole(path: Path, content: bytes) -> dict[tuple[str, str], Path]:
    """Return the path of each frame of each test."""
    path.write_bytes(content)
    return {(job.frame, job.test): job.path for job in read_manifest(path).jobs}


@pytest.mark.parametrize(("name", "content"), [("m.csv", CSV), ("m.jsonl", JSON_LINES)])
@law
@given(st.lists(damage, min_size=1, max_size=3))
def test_a_damaged_manifest(name: str, content: bytes, how: list[tuple[int, bytes | None]]) -> None:
    for each in how:
        content = damaged(content, each)
    with folder() as place:
        (place / name).write_bytes(content)
        try:
            check_matched(read_manifest(place / name))
        except EvaluationError as error:
            check_told(error, name)


@pytest.mark.parametrize("name", ["m.csv", "m.jsonl"])
@law
@given(st.binary(max_size=200))
def test_bytes_that_are_no_manifest(name: str, content: bytes) -> None:
    with folder() as place:
        (place / name).write_bytes(content)
        try:
            check_matched(read_manifest(place / name))
        except EvaluationError as error:
            check_told(error, name)


@law
@given(st.lists(st.tuples(names, names, names, names), min_size=1, max_size=4))
def test_a_manifest_of_any_names(rows: list[tuple[str, str, str, str]]) -> None:
    lines = [json.dumps(dict(zip(COLUMNS, row, strict=True))) for row in rows]
    with folder() as place:
        (place / "m.jsonl").write_text("\n".join(lines))
        try:
            found = read_manifest(place / "m.jsonl")
        except EvaluationError as error:
            check_told(error, "m.jsonl")
        else:
            check_matched(found)
            assert {(job.frame, job.test) for job in found.jobs} == {(r[0], r[2]) for r in rows}


# Parts of file names and patterns: what wildcards, regular expressions and shells take for signs.
parts = st.text("ab01*?[]!-^\\.(){}+|$ é", min_size=1, max_size=6)


@law
@given(st.lists(parts.filter(lambda part: not part.startswith(".")), max_size=4), parts, parts)
def test_any_pattern_over_any_names(files: list[str], first: str, second: str) -> None:
    with folder() as place:
        for name in files:
            (place / f"{name}.exr").write_bytes(b"content")
            (place / "sub").mkdir(exist_ok=True)
            (place / "sub" / f"{name}.png").write_bytes(b"content")
        for pattern in (f"{first}{second}", f"*/{first}", f"**/{first}*", f"{first}/**"):
            there = glob.glob(f"{place}/{pattern}", recursive=True)  # noqa: PTH207 - as a user's shell
            images = [each for each in there if Path(each).suffix.lower() in SUFFIXES]
            try:
                found = match(f"{place}/{pattern}", {"A": f"{place}/**/*.*"}, place / "out")
            except EvaluationError as error:
                check_told(error, str(place))
                assert not images
            else:
                check_matched(found)
        if files:  # a folder has each of its files, once
            found = match(str(place), {"A": str(place)}, place / "out")
            check_matched(found)
            stems = {Path(f"{name}.exr").stem for name in files}
            assert len(found.jobs) + len(found.missing) == 2 * len(stems)


def read(folder: Path) -> dict[tuple[str, str], Result]:
    """Return what a journal has."""
    with Journal(folder) as lines:
        return dict(lines)


def results(count: int) -> list[Result]:
    return [
        Result(
            frame=f"hall/{number}",
            test="A",
            key=f"{number:064}",
            figures={"max_jnd": number / 3, "psnr": None},
            size=(4, 3),
            counts=[1, 2],
            regions=[(0, 0, 2, 2, 1.5)],
            pictures={"map": "m"},
            notes=["é"],
        )
        for number in range(count)
    ]


def test_a_journal_that_is_cut_off_anywhere(tmp_path: Path) -> None:
    added = results(3)
    lines = [each.line() for each in added]
    content = b"".join(lines)
    ends = [sum(map(len, lines[: number + 1])) for number in range(3)]
    for place in range(len(content) + 1):
        (tmp_path / NAME).write_bytes(content[:place])
        whole = sum(end <= place for end in ends)
        assert list(read(tmp_path)) == [(each.frame, "A") for each in added[:whole]]
        with Journal(tmp_path) as journal:  # as a run that goes on
            for each in added[whole:]:
                journal.add(each)
        assert (tmp_path / NAME).read_bytes() == content


@law
@given(st.lists(damage, min_size=1, max_size=4))
def test_a_damaged_journal_loses_no_other_line(how: list[tuple[int, bytes | None]]) -> None:
    added = results(4)
    lines = [each.line() for each in added]
    content = b"".join(lines)
    for each in how:
        content = damaged(content, each)
    with folder() as place:
        (place / NAME).write_bytes(content)
        known = read(place)
        # A line that still stands as it was written is known, whatever is beside it.
        standing = content.split(b"\n")[:-1]
        for result in added:
            if result.line().rstrip(b"\n") in standing:
                assert known[result.frame, "A"].line() == result.line()
        # What is known can be written and read again, and a run that goes on has each frame once.
        with Journal(place) as journal:
            for result in (*known.values(), *added):
                journal.add(result)
        again = read(place)
        assert set(again) == set(known) | {(each.frame, "A") for each in added}
        for result in added:
            assert again[result.frame, "A"].line() == result.line()


@law
@given(st.integers(0, 10_000), st.integers(1, 255))
def test_a_byte_that_changed_makes_its_line_count_for_nothing(place: int, change: int) -> None:
    added = results(3)
    content = bytearray(b"".join(each.line() for each in added))
    content[place % len(content)] ^= change
    with folder() as where:
        (where / NAME).write_bytes(content)
        for key, result in read(where).items():
            assert result.line() in {each.line() for each in added}, key
        assert len(read(where)) >= 1


@law
@given(st.sampled_from(sorted(json.loads(results(1)[0].line()))), st.none() | st.text(max_size=3))
def test_a_value_of_another_makes_its_line_count_for_nothing(name: str, value: str | None) -> None:
    fields = json.loads(results(1)[0].line())
    for changed in (fields | {name: value}, {k: v for k, v in fields.items() if k != name}):
        with folder() as place:
            line = json.dumps(changed).encode() + b"\n"
            (place / NAME).write_bytes(line + b"[]\n1\n{}\n" + results(2)[1].line())
            known = {key: result.line() for key, result in read(place).items()}
            same = {("hall/0", "A"): line} if changed == fields else {}
            assert known == same | {("hall/1", "A"): results(2)[1].line()}
