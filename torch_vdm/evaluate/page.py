"""``report.html``: a file that needs no network, and loads pictures as it shows them."""

import base64
import html
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from torch_vdm.evaluate import maps, pictures
from torch_vdm.evaluate.journal import Result
from torch_vdm.evaluate.judge import MAPS, PICTURES
from torch_vdm.evaluate.tables import FIGURES, present
from torch_vdm.io import atomic_path
from torch_vdm.report import SMALLEST_SCALE


def write(
    path: Path,
    tests: Sequence[str],
    results: Sequence[Result],
    sentences: Sequence[str],
    settings: dict[str, object],
    assumptions: Sequence[str],
) -> None:
    """Write the page.

    Parameters
    ----------
    path
        The page; maps and pictures lie in folders beside it.
    tests
        Their names, in order.
    results
        All, frame by frame.
    sentences
        What is said of the tests beside one another.
    settings
        By name.
    assumptions
        What was assumed for all frames, one sentence each.
    """
    names = present(results)
    data = {
        "tests": list(tests),
        "figures": [{"name": name, **FIGURES[name]._asdict()} for name in names],
        "rows": [_row(result, tests, names) for result in results if not result.skipped],
        "skipped": [[r.frame, r.test, r.skipped] for r in results if r.skipped],
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
    package = files("torch_vdm.evaluate")
    parts = {
        "title": html.escape("Visible differences: " + ", ".join(tests)),
        "style": (package / "page.css").read_text("utf-8"),
        "script": (package / "page.js").read_text("utf-8"),
        "data": _in_script(data),
    }
    text = (package / "page.html").read_text("utf-8")
    for name, part in parts.items():
        before, mark, after = text.partition(f"<!-- {name} -->")
        assert mark, name
        text = before + part + after
    with atomic_path(path) as temporary:
        temporary.write_bytes(text.encode(errors="backslashreplace"))


def _row(result: Result, tests: Sequence[str], names: Sequence[str]) -> list[object]:
    """Return what the page knows of a frame of a test, in the order in which its script reads."""
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
