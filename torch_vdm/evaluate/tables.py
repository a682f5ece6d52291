"""The files that hold the figures of all frames: JSON, CSV, Parquet, JUnit XML."""

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any
from xml.sax.saxutils import XMLGenerator
from xml.sax.xmlreader import AttributesImpl

from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.overview import Overview
from torch_vdm.io import atomic_path

# Columns that hold text and whole numbers, and the lines of a table that are written at once.
TEXT, WHOLE = {"frame", "test", "skipped"}, {"width", "height", "max_x", "max_y"}
AT_ONCE = 4096


def columns(names: Iterable[str]) -> list[str]:
    """Return the columns of a table with these figures."""
    return ["frame", "test", *names, "width", "height", "max_x", "max_y", "seconds", "skipped"]


def row(result: Result, names: Iterable[str]) -> list[object]:
    """Return the values of the columns; None for a missing one."""
    figures = [result.figures.get(name) for name in names]
    rest: tuple[object, ...] = (None,) * 5
    if not result.skipped:
        rest = (*result.size, *result.max_pixel, result.seconds[0])
    return [result.frame, result.test, *figures, *rest, result.skipped or None]


def write_csv(path: Path, names: Sequence[str], results: Iterable[Result]) -> None:
    """Write a line for each frame and test; a missing value is empty."""
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(columns(names))
        writer.writerows(row(result, names) for result in results)


def write_parquet(path: Path, names: Sequence[str], results: Iterable[Result]) -> None:
    """Write the same table as Parquet; it needs pyarrow."""
    import pyarrow
    from pyarrow import parquet

    def kind(name: str) -> Any:
        if name in TEXT:
            return pyarrow.string()
        return pyarrow.int64() if name in WHOLE else pyarrow.float64()

    schema = pyarrow.schema([(name, kind(name)) for name in columns(names)])
    lines = (dict(zip(schema.names, row(result, names), strict=True)) for result in results)
    with atomic_path(path) as temporary, parquet.ParquetWriter(temporary, schema) as writer:
        while some := list(islice(lines, AT_ONCE)):
            writer.write_table(pyarrow.Table.from_pylist(some, schema))


def write_json(path: Path, told: Mapping[str, object], results: Iterable[Result]) -> None:
    """Write the entries of ``told``, and under ``frames`` all results, a line for each."""
    head, end = json.dumps({**told, "frames": []}, indent=1, allow_nan=False).rsplit("]", 1)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(head)
        for number, result in enumerate(results):
            file.write(",\n  " if number else "\n  ")
            file.write(json.dumps(asdict(result), allow_nan=False))
        file.write(f"\n ]{end}\n")


def write_junit(
    path: Path, overview: Overview, results: Iterable[Result], fail_above: float | None
) -> None:
    """Write a test case for each frame and test.

    A failure is a frame whose maximum is over ``fail_above``; a frame that could not be compared is
    skipped.
    """
    exceeded = overview.exceeded(fail_above)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        xml = XMLGenerator(file, "utf-8", short_empty_elements=True)
        xml.startDocument()
        _start(xml, "testsuites", {"name": "torch-vdm evaluate"})
        for number, test in enumerate(overview.tests):
            xml.ignorableWhitespace("\n")
            counts = {
                "tests": overview.compared[number] + overview.skipped[number],
                "failures": exceeded[number],
                "errors": 0,
                "skipped": overview.skipped[number],
                "time": f"{overview.seconds[number]:.3f}",
            }
            _start(xml, "testsuite", {"name": test} | {n: str(c) for n, c in counts.items()})
            for result in results:
                if result.test == test:
                    _add_case(xml, result, fail_above)
            xml.ignorableWhitespace("\n")
            xml.endElement("testsuite")
        xml.ignorableWhitespace("\n")
        xml.endElement("testsuites")
        xml.endDocument()


def exceeds(result: Result, fail_above: float | None) -> bool:
    """Return whether the maximum of a frame is over ``fail_above``."""
    largest = result.figures.get("max_jnd")
    return fail_above is not None and largest is not None and largest > fail_above


def _start(xml: XMLGenerator, name: str, attributes: dict[str, str]) -> None:
    xml.startElement(name, AttributesImpl(attributes))


def _add_case(xml: XMLGenerator, result: Result, fail_above: float | None) -> None:
    xml.ignorableWhitespace("\n ")
    seconds = f"{result.seconds[1]:.3f}"
    _start(xml, "testcase", {"classname": result.test, "name": result.frame, "time": seconds})
    if result.skipped:
        _start(xml, "skipped", {"message": result.skipped})
        xml.endElement("skipped")
    elif exceeds(result, fail_above):
        largest, share = result.figures["max_jnd"], result.figures["visible_fraction"]
        x, y = result.max_pixel
        message = f"{largest:.2f} JND at x {x}, y {y}, over {fail_above:g}; {share:.1%} visible"
        _start(xml, "failure", {"message": message})
        xml.endElement("failure")
    xml.endElement("testcase")
