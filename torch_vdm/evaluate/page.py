"""``report.html``: a file that needs no network, and loads pictures as it shows them."""

import base64
import html
import json
from collections.abc import Iterable, Iterator, Sequence
from importlib.resources import files
from itertools import chain
from pathlib import Path

from torch_vdm.evaluate import maps, pictures
from torch_vdm.evaluate.figures import FIGURES
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.judge import MAPS, PICTURES
from torch_vdm.evaluate.overview import Overview
from torch_vdm.io import atomic_path
from torch_vdm.report import SMALLEST_SCALE

# The page's own scripts, in the order in which they build on one another. D3, which lies next to
# them, draws plots, zoom and the rows of tables.
SCRIPTS = ("data.js", "summary.js", "pictures.js", "frame.js", "controls.js")


def write(
    path: Path,
    overview: Overview,
    results: Iterable[Result],
    sentences: Sequence[str],
    settings: dict[str, object],
    assumptions: Sequence[str],
) -> None:
    """Write the page.

    Parameters
    ----------
    path
        The page; maps and pictures lie in folders next to it.
    overview, results
        All results, frame by frame.
    sentences
        The sentences that compare the tests.
    settings
        Settings by name.
    assumptions
        What was assumed for all frames, one sentence each.
    """
    tests, names = overview.tests, list(overview.values)
    data = {
        "tests": list(tests),
        "figures": [{"name": name, **FIGURES[name]._asdict()} for name in names],
        "sentences": list(sentences),
        "settings": [
            [name, str(value)] for name, value in settings.items() if value not in (None, "")
        ],
        "assumptions": list(assumptions),
        "fail_above": settings.get("fail_above"),
        "borders": maps.BORDERS,
        "palette": base64.b64encode(pictures.palette().tobytes()).decode(),
        "scale": SMALLEST_SCALE,
        "steps": pictures.STEPS,
        "maps": MAPS,
        "pictures": PICTURES,
    }
    rows = (_row(result, tests, names) for result in results if not result.skipped)
    skipped = ([r.frame, r.test, r.skipped] for r in results if r.skipped)
    web = files("torch_vdm.evaluate") / "web"
    parts: dict[str, Iterable[str]] = {
        "title": [html.escape("Visible differences: " + ", ".join(tests))],
        "style": [(web / "page.css").read_text("utf-8")],
        "data": chain(
            [_in_script(data)[:-1], ',"rows":['],
            _listed(rows),
            ['],"skipped":['],
            _listed(skipped),
            ["]}"],
        ),
        "library": [(web / "d3.min.js").read_text("utf-8")],
        "script": ((web / name).read_text("utf-8") for name in SCRIPTS),
    }
    text = (web / "page.html").read_text("utf-8")
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="backslashreplace") as file,
    ):
        for name, part in parts.items():
            before, mark, text = text.partition(f"<!-- {name} -->")
            assert mark, name
            file.write(before)
            file.writelines(part)
        file.write(text)


def _listed(values: Iterable[object]) -> Iterator[str]:
    """Yield the elements of a list in JSON."""
    for number, value in enumerate(values):
        yield ("," if number else "") + _in_script(value)


def _row(result: Result, tests: Sequence[str], names: Sequence[str]) -> list[object]:
    """Return the page's data of a frame of a test, in the order in which its script reads them."""
    return [
        result.frame,
        tests.index(result.test),
        [result.figures.get(name) for name in names],
        result.size,
        result.max_pixel,
        result.counts,
        [[*region[:4], round(region[4], 2)] for region in result.regions],
        [result.pictures[name] for name in ("reference", "test", "map")],
        result.block,
        result.notes,
    ]


def _in_script(data: object) -> str:
    """Return JSON that may stand in a script element, whatever names are in it."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
