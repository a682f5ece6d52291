"""What is said of all frames together, against plain lists of the same figures."""

import csv
import json
import statistics
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from torch_vdm.evaluate import page, tables
from torch_vdm.evaluate.journal import Journal, Result, Selection
from torch_vdm.evaluate.overview import Overview

# Maxima of tests A and B on four frames; None is skipped.
MAXIMA = {"1": (0.5, 2.0), "2": (None, 1.0), "3": (3.0, 1.5), "4": (0.25, None)}


def made(frame: str, test: str, largest: float | None) -> Result:
    if largest is None:
        return Result(frame=frame, test=test, skipped="broken <&>")
    return Result(
        frame=frame,
        test=test,
        figures={
            "max_jnd": largest,
            "visible_fraction": 0.5,
            "psnr": None if largest == 3.0 else 30.0,
        },
        size=(4, 3),
        counts=[1] * 35,
        pictures={"reference": "r", "test": "t", "map": "m"},
        seconds=(0.5, 1.0),
    )


@pytest.fixture
def results() -> list[Result]:
    return [
        made(frame, test, largest)
        for frame, both in MAXIMA.items()
        for test, largest in zip("AB", both, strict=True)
    ]


def test_numbers_are_those_of_the_results(results: list[Result]) -> None:
    found = Overview.of(["A", "B"], 4, results)
    assert (found.compared, found.skipped, found.seconds) == ([3, 3], [1, 1], [3.0, 3.0])
    assert list(found.values) == ["max_jnd", "visible_fraction", "psnr"]
    assert found.column("max_jnd", "A").tolist() == [0.5, 3.0, 0.25]
    assert found.column("psnr", "A").tolist() == [30.0, 30.0]
    assert found.exceeded(1.5) == [1, 1]
    assert found.exceeded(None) == [0, 0]
    assert found.worst == results[4]
    assert [each.frame for each in found.first_skipped] == ["2", "4"]
    (pair,) = found.compare(["max_jnd", "flicker_max_jnd"])
    assert (pair.frames, pair.lower, pair.higher) == (2, 1, 1)
    assert pair.median == statistics.median([2.0 - 0.5, 1.5 - 3.0])
    told = json.loads(json.dumps(found.summary(0.3)))["tests"]["A"]
    assert (told["compared"], told["skipped"], told["exceeded"]) == (3, 1, 2)
    assert told["figures"]["max_jnd"] == {"median": 0.5, "least": 0.25, "most": 3.0}


def test_nothing_that_was_compared() -> None:
    found = Overview.of(["A"], 1, [made("1", "A", None)])
    assert (found.compared, found.exceeded(1.0), found.worst) == ([0], [0], None)
    assert found.compare(["max_jnd"]) == []


def test_tables_hold_every_result(tmp_path: Path, results: list[Result]) -> None:
    found = Overview.of(["A", "B"], 4, results)
    names = list(found.values)
    tables.write_csv(tmp_path / "t.csv", names, results)
    lines = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert [(line["frame"], line["test"]) for line in lines] == [(r.frame, r.test) for r in results]
    assert (lines[0]["max_jnd"], lines[0]["width"], lines[0]["skipped"]) == ("0.5", "4", "")
    assert (lines[2]["max_jnd"], lines[2]["width"], lines[2]["skipped"]) == ("", "", "broken <&>")
    tables.write_json(tmp_path / "r.json", {"settings": {"ppd": 60.0}}, results)
    told = json.loads((tmp_path / "r.json").read_text())
    assert told["settings"] == {"ppd": 60.0}
    assert [frame["figures"] for frame in told["frames"]] == [r.figures for r in results]
    tables.write_json(tmp_path / "r.json", {}, [])
    assert json.loads((tmp_path / "r.json").read_text()) == {"frames": []}
    tables.write_junit(tmp_path / "j.xml", found, results, 1.5)
    suites = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert [suite.attrib["name"] for suite in suites] == ["A", "B"]
    for suite, test in zip(suites, "AB", strict=True):
        own = [result for result in results if result.test == test]
        assert [case.attrib["name"] for case in suite] == [result.frame for result in own]
        for child, attribute in (("skipped", "skipped"), ("failure", "failures")):
            assert len(suite.findall(f"testcase/{child}")) == int(suite.attrib[attribute]) == 1
    assert suites[0][1][0].attrib["message"] == "broken <&>"


class Same(dict[tuple[str, str], Result]):
    """Stands for a journal of many frames: makes the same result for any."""

    def __missing__(self, key: tuple[str, str]) -> Result:
        """Return a result."""
        return made(key[0], key[1], 0.5)


def test_memory_is_flat_while_tables_and_page_are_written(tmp_path: Path) -> None:
    """Ten times the frames take hardly more: 3 figures of 8 bytes each, and what is not collected.

    Results that are held take 2 kB each.
    """

    def peak(count: int) -> int:
        keys = [(str(number), "A") for number in range(count)]
        many = Selection(Same(), keys)
        tracemalloc.start()
        found = Overview.of(["A"], count, many)
        names = list(found.values)
        tables.write_json(tmp_path / "r.json", {}, many)
        tables.write_csv(tmp_path / "t.csv", names, many)
        tables.write_junit(tmp_path / "j.xml", found, many, None)
        page.write(tmp_path / "p.html", found, many, [], {}, [])
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    peak(10)
    assert peak(1000) < peak(100) + 900 * 3 * 8 + 500_000


def test_a_journal_holds_places_alone(tmp_path: Path) -> None:
    def size(count: int) -> int:
        def lines() -> Iterator[bytes]:
            return (made(str(number), "A", 0.5).line() for number in range(count))

        (tmp_path / "journal.jsonl").write_bytes(b"".join(lines()))
        tracemalloc.start()
        with Journal(tmp_path) as journal:
            assert journal["7", "A"].frame == "7"
            held = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        return held

    # A key of two short texts and a number; its line has 600 bytes, and more as a `Result`.
    assert (size(2000) - size(200)) / 1800 < 400
