"""The figures of a frame by name, and the files that hold them: JSON, CSV, Parquet, JUnit XML."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.statistics import Paired
from torch_vdm.io import atomic_path


class Figure(NamedTuple):
    """How a figure is shown.

    Attributes
    ----------
    label
        What it is called.
    digits
        After the point.
    percent
        Whether it is a share.
    more_is_better
        False where less is better.
    help
        What it is, in one sentence.
    """

    label: str
    digits: int
    percent: bool
    more_is_better: bool
    help: str


FIGURES = {
    "max_jnd": Figure("max", 2, False, False, "Largest visible difference, JND."),
    "mean_jnd": Figure("mean", 3, False, False, "Mean of the map, JND."),
    "p95_jnd": Figure("p95", 2, False, False, "95 % of the pixels show no more, JND."),
    "visible_fraction": Figure("visible", 1, True, False, "Share of the pixels over 1 JND."),
    "mean_luminance_change": Figure(
        "luminance", 2, True, False, "Mean luminance of the test relative to the reference."
    ),
    "flicker_max_jnd": Figure(
        "flicker", 2, False, False, "Largest visible change of the error since the frame before."
    ),
    "flicker_mean_jnd": Figure(
        "flicker mean", 3, False, False, "Mean visible change of the error, JND."
    ),
    "flicker_visible_fraction": Figure(
        "flicker visible", 1, True, False, "Share of the pixels whose error changes by over 1 JND."
    ),
    "psnr": Figure("PSNR", 1, False, True, "dB, sRGB-coded; none where the images are equal."),
    "ssim": Figure("SSIM", 4, False, True, "Mean over the image, luma, sRGB-coded."),
    "flip": Figure("FLIP", 4, False, False, "Mean error, sRGB-coded."),
    "cvvdp": Figure("cvvdp", 2, False, True, "Quality in JOD, 10 is best."),
}


def present(results: Sequence[Result]) -> list[str]:
    """Return the figures that any frame has, in order."""
    names = {name for result in results for name in result.figures}
    return [name for name in FIGURES if name in names]


def columns(results: Sequence[Result]) -> dict[str, list[object]]:
    """Return a table of the results, a list for each column."""
    table: dict[str, list[object]] = {
        "frame": [result.frame for result in results],
        "test": [result.test for result in results],
    }
    for name in present(results):
        table[name] = [result.figures.get(name) for result in results]
    done = [not result.skipped for result in results]
    for name, axis in (("width", 0), ("height", 1)):
        table[name] = [
            result.size[axis] if judged else None
            for result, judged in zip(results, done, strict=True)
        ]
    for name, axis in (("max_x", 0), ("max_y", 1)):
        table[name] = [
            result.max_pixel[axis] if judged else None
            for result, judged in zip(results, done, strict=True)
        ]
    table["seconds"] = [result.seconds[0] if not result.skipped else None for result in results]
    table["skipped"] = [result.skipped or None for result in results]
    return table


def write_csv(path: Path, results: Sequence[Result]) -> None:
    """Write a line for each frame and test; what has no value is empty."""
    table = columns(results)
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.getvalue().encode(errors="backslashreplace"))


def write_parquet(path: Path, results: Sequence[Result]) -> None:
    """Write the same table as Parquet; it needs pyarrow."""
    import pyarrow
    from pyarrow import parquet

    text = {"frame", "test", "skipped"}
    whole = {"width", "height", "max_x", "max_y"}
    fields = {
        name: pyarrow.array(
            values,
            pyarrow.string()
            if name in text
            else pyarrow.int64()
            if name in whole
            else pyarrow.float64(),
        )
        for name, values in columns(results).items()
    }
    with atomic_path(path) as temporary:
        parquet.write_table(pyarrow.table(fields), temporary)


def write_json(
    path: Path,
    settings: dict[str, object],
    summary: dict[str, object],
    compared: Sequence[Paired],
    results: Sequence[Result],
) -> None:
    """Write settings, summary, comparisons and all results."""
    told = {
        "settings": settings,
        "summary": summary,
        "comparisons": [asdict(pair) for pair in compared],
        "frames": [asdict(result) for result in results],
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(told, indent=1, allow_nan=False) + "\n")


def write_junit(path: Path, results: Sequence[Result], fail_above: float | None) -> None:
    """Write a test case for each frame and test.

    A failure is a frame whose maximum is over ``fail_above``; a frame that could not be compared is
    skipped.
    """
    root = ElementTree.Element("testsuites", name="torch-vdm evaluate")
    for test in dict.fromkeys(result.test for result in results):
        cases = [result for result in results if result.test == test]
        suite = ElementTree.SubElement(root, "testsuite", name=test)
        for case in cases:
            _add_case(suite, case, fail_above)
        counts = {
            "tests": len(cases),
            "failures": sum(exceeds(case, fail_above) for case in cases),
            "errors": 0,
            "skipped": sum(bool(case.skipped) for case in cases),
        }
        for name, value in counts.items():
            suite.set(name, str(value))
        suite.set("time", f"{sum(case.seconds[1] for case in cases):.3f}")
    ElementTree.indent(root)
    with atomic_path(path) as temporary:
        temporary.write_bytes(ElementTree.tostring(root, "utf-8", xml_declaration=True) + b"\n")


def exceeds(result: Result, fail_above: float | None) -> bool:
    """Say whether the maximum of a frame is over what was asked for."""
    largest = result.figures.get("max_jnd")
    return fail_above is not None and largest is not None and largest > fail_above


def _add_case(suite: ElementTree.Element, result: Result, fail_above: float | None) -> None:
    case = ElementTree.SubElement(
        suite,
        "testcase",
        classname=result.test,
        name=result.frame,
        time=f"{result.seconds[1]:.3f}",
    )
    if result.skipped:
        ElementTree.SubElement(case, "skipped", message=result.skipped)
    elif exceeds(result, fail_above):
        largest, share = result.figures["max_jnd"], result.figures["visible_fraction"]
        x, y = result.max_pixel
        ElementTree.SubElement(
            case,
            "failure",
            message=f"{largest:.2f} JND at x {x}, y {y}, over {fail_above:g}; {share:.1%} visible",
        )
