"""``torch-vdm evaluate``: from options to a folder with results and a report."""

import argparse
import importlib.util
import io
import sys
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_vdm import __version__, cluster
from torch_vdm.evaluate import journal, page, peers, tables, workers
from torch_vdm.evaluate.cluster import results as on_cluster
from torch_vdm.evaluate.figures import FIGURES
from torch_vdm.evaluate.frames import (
    EvaluationError,
    Job,
    Matched,
    match,
    natural,
    read_manifest,
)
from torch_vdm.evaluate.journal import Journal, Result, Selection
from torch_vdm.evaluate.judge import PICTURES, Bench, Judge, map_paths, settings
from torch_vdm.evaluate.overview import Overview
from torch_vdm.evaluate.statistics import counted
from torch_vdm.io import check_target, remove_abandoned
from torch_vdm.report import plain_console, progress

RESULTS, TABLE, PARQUET, REPORT = "results.json", "table.csv", "table.parquet", "report.html"

# Figures by which tests are compared with one another, and the words for them.
COMPARED = {
    "max_jnd": "Maximum",
    "p95_jnd": "95th percentile",
    "mean_jnd": "Mean",
    "flicker_max_jnd": "Flicker, maximum",
}

# Figures for which the terminal has no room; they are in the table that is written.
NOT_IN_TERMINAL = ("mean_luminance_change", "flicker_mean_jnd", "flicker_visible_fraction")


class Outcome(NamedTuple):
    """The text at the end, and whether a maximum was over ``--fail-above``."""

    text: str
    exceeded: bool


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``evaluate`` that say what to compare and where to write."""
    frames = parser.add_argument_group("frames")
    frames.add_argument(
        "--reference",
        metavar="DIR|PATTERN",
        help="a folder of images, or a pattern such as 'a/*.exr'",
    )
    frames.add_argument(
        "--test",
        type=_named,
        action="append",
        metavar="NAME=DIR|PATTERN",
        help="a test's name and its images, matched by name; as often as there are tests",
    )
    frames.add_argument(
        "--manifest",
        type=Path,
        metavar="FILE",
        help="instead: CSV or JSON lines with frame, reference, test and path",
    )
    work = parser.add_argument_group("work")
    work.add_argument("--output", type=Path, required=True, metavar="DIR", help="where results go")
    work.add_argument(
        "--jobs",
        type=_count,
        metavar="N",
        help="processes that share the work (1; with --scheduler local one a processor)",
    )
    work.add_argument(
        "--scheduler",
        metavar="ADDRESS|FILE|local",
        help="share the work among the workers of a Dask scheduler: its address, tcp://host:8786, "
        "or its scheduler file; 'local' starts one with --jobs workers on this machine",
    )
    work.add_argument(
        "--resume", action="store_true", help="go on: what is done with these settings stands"
    )
    work.add_argument(
        "--flicker",
        action="store_true",
        help="for numbered frames: the visible change of the error since the frame before",
    )
    work.add_argument(
        "--peers",
        type=_peers,
        default=[],
        metavar="NAME,...",
        help=f"other metrics beside PSNR and SSIM: {', '.join(peers.PACKAGES)}",
    )
    work.add_argument("--junit", type=Path, metavar="OUT.xml", help="a test case for each frame")
    work.add_argument("--parquet", action="store_true", help="the table as Parquet too")


def run(options: argparse.Namespace, bench: Bench, assumptions: Sequence[str]) -> Outcome:
    """Compare all frames and write the results.

    Parameters
    ----------
    options
        Those of `add_arguments`, ``fail_above``, and those that ``bench`` takes.
    bench
        How files are read and judged.
    assumptions
        What was assumed for all frames, one sentence each.

    Raises
    ------
    EvaluationError
        If the options do not fit together, or nothing could be compared.
    ImageError
        If the output cannot be written.
    """
    _check_installed(options)
    matched = _matched(options)
    _prepare(options)
    with Journal(options.output) as lines:
        _work_through(options, bench, matched, lines)
        _clear(options.output, matched)
        keys = _ordered(matched)
        results = Selection(lines, keys)
        frames = len({frame for frame, _ in keys})
        overview = Overview.of(matched.tests, frames, results)
        sentences = _write(options, overview, results, assumptions)
    _check_any(overview)
    exceeded = sum(overview.exceeded(options.fail_above))
    return Outcome(_text(options, overview, sentences, exceeded), bool(exceeded))


def _write(
    options: argparse.Namespace,
    overview: Overview,
    results: Iterable[Result],
    assumptions: Sequence[str],
) -> list[str]:
    """Write tables and report; return the sentences that compare the tests."""
    compared = overview.compare(COMPARED)
    sentences = [pair.sentence(COMPARED[pair.figure]) for pair in compared]
    output: Path = options.output
    told = {
        "version": __version__,
        "reference": options.reference,
        "tests": ", ".join(f"{name}={place}" for name, place in options.test or ()),
        "manifest": None if options.manifest is None else str(options.manifest),
        "fail_above": options.fail_above,
        **settings(options),
    }
    of_all = {
        "settings": told,
        "summary": overview.summary(options.fail_above),
        "comparisons": [asdict(pair) for pair in compared],
    }
    names = list(overview.values)
    tables.write_json(output / RESULTS, of_all, results)
    tables.write_csv(output / TABLE, names, results)
    if options.parquet:
        tables.write_parquet(output / PARQUET, names, results)
    if options.junit:
        tables.write_junit(options.junit, overview, results, options.fail_above)
    page.write(output / REPORT, overview, results, sentences, told, assumptions)
    return sentences


def _matched(options: argparse.Namespace) -> Matched:
    if options.manifest is not None:
        if options.reference is not None or options.test:
            raise EvaluationError(
                "expected --manifest alone, or --reference and --test; give one of the two"
            )
        return read_manifest(options.manifest)
    if options.reference is None or not options.test:
        raise EvaluationError(
            "expected --reference DIR and --test NAME=DIR, or --manifest FILE; give what to compare"
        )
    tests = dict(options.test)
    if len(tests) < len(options.test):
        raise EvaluationError("expected tests of different names; rename one")
    return match(options.reference, tests, options.output)


def _check_installed(options: argparse.Namespace) -> None:
    """Refuse, before anything is computed, what lacks a package or has no meaning."""
    if options.scheduler:
        cluster.check(options.scheduler, options.jobs)
    missing = peers.missing(options.peers)
    if missing:
        raise EvaluationError(f"--peers {','.join(missing)}: not installed; {peers.EXTRA}")
    if options.parquet and importlib.util.find_spec("pyarrow") is None:
        raise EvaluationError(
            "--parquet: pyarrow is not installed; pip install 'torch-vdm[report]'"
        )


def _prepare(options: argparse.Namespace) -> None:
    """Make the output folder, unless one with results is in the way."""
    output: Path = options.output
    if output.exists() and not output.is_dir():
        raise EvaluationError(f"{output}: expected a folder to write to, got a file")
    holds = [name for name in (journal.NAME, RESULTS, REPORT) if (output / name).exists()]
    if holds and not options.resume:
        raise EvaluationError(
            f"{output}: expected a folder without results, got one with {holds[0]}; go on with "
            "--resume, or name another"
        )
    output.mkdir(parents=True, exist_ok=True)
    if options.junit:  # it may lie in the output folder
        check_target(options.junit)


def _work_through(
    options: argparse.Namespace, bench: Bench, matched: Matched, lines: Journal
) -> None:
    """Add the results of all frames to the journal, each as it comes."""
    judge = Judge(bench, options, options.output)
    with (
        closing(_coming(judge, matched.jobs, lines, options)) as coming,
        progress("comparing", len(matched.jobs)) as advance,
    ):
        for missing in matched.missing:
            _add(lines, Result(frame=missing.frame, test=missing.test, skipped=missing.why))
        try:
            for result in coming:
                _add(lines, result)
                advance()
        except KeyboardInterrupt:
            print(f"what is done is kept in {options.output}; --resume goes on", file=sys.stderr)
            raise


def _clear(output: Path, matched: Matched) -> None:
    """Remove what workers that were killed left half-written."""
    # Whole folders: the name of a picture that was never written is not known.
    maps = {map_paths(output, job.frame, job.test)[0].parent for job in matched.jobs}
    remove_abandoned((), [*maps, output / PICTURES])


def _ordered(matched: Matched) -> list[tuple[str, str]]:
    """Return all frames and tests that were asked for, in their order."""
    place = {test: number for number, test in enumerate(matched.tests)}
    keys = {(job.frame, job.test) for job in matched.jobs}
    keys |= {(missing.frame, missing.test) for missing in matched.missing}
    return sorted(keys, key=lambda key: (natural(key[0]), place[key[1]]))


def _coming(
    judge: Judge, jobs: Sequence[Job], lines: Journal, options: argparse.Namespace
) -> Generator[Result, None, None]:
    """Yield the results of jobs as they come, from a cluster or from processes of this machine."""
    if options.scheduler is None:
        return workers.results(judge, jobs, lines, options.jobs or 1)
    return on_cluster(judge, jobs, lines, options.scheduler, options.jobs)


def _add(lines: Journal, result: Result) -> None:
    """Add a result to the journal, unless the journal has it."""
    known = lines.get((result.frame, result.test))
    if known is None or known.line() != result.line():
        lines.add(result)


def _check_any(overview: Overview) -> None:
    if not any(overview.compared):
        first = overview.first_skipped[0]
        raise EvaluationError(
            f"nothing could be compared: {counted(sum(overview.skipped), 'comparison')} skipped, "
            f"the first is {first.frame} of {first.test}: {first.skipped}"
        )


def _text(
    options: argparse.Namespace, overview: Overview, sentences: Sequence[str], exceeded: int
) -> str:
    """Return the text for the terminal at the end."""
    text = io.StringIO()
    console = plain_console(text, 100)
    console.print(_table(overview))
    for sentence in sentences:
        console.print(sentence, style="bold")
    skipped = sum(overview.skipped)
    if skipped:
        of = counted(skipped + sum(overview.compared), "comparison")
        console.print(f"Skipped {skipped} of {of}:")
        for result in overview.first_skipped:
            console.print(f"  {result.frame} of {result.test}: {result.skipped}")
        if skipped > len(overview.first_skipped):
            console.print(f"  and {skipped - len(overview.first_skipped)} more, in {TABLE}")
    worst = overview.worst
    if exceeded and worst is not None:
        console.print(
            f"Over {options.fail_above:g} JND: {counted(exceeded, 'comparison')}; the worst "
            f"is {worst.frame} of {worst.test}, {worst.figures['max_jnd']:.2f} JND"
        )
    console.print(f"written: {options.output / REPORT}", style="dim")
    return text.getvalue()


def _table(overview: Overview) -> Any:
    """Return a table of medians over the frames, a line for each test."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    names = [name for name in overview.values if name not in NOT_IN_TERMINAL]
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, title="Median over the frames")
    for heading in ("test", "frames", "worst", *(FIGURES[name].label for name in names)):
        grid.add_column(heading, justify="left" if heading == "test" else "right")
    for test, count in zip(overview.tests, overview.compared, strict=True):
        cells = [test, str(count), f"{overview.column('max_jnd', test).max():.2f}" if count else ""]
        for name in names:
            values = overview.column(name, test)
            cells.append(shown(name, float(np.median(values))) if len(values) else "")
        grid.add_row(*(Text(cell) for cell in cells))
    return grid


def shown(name: str, value: float) -> str:
    """Return a figure as text, with its number of digits."""
    figure = FIGURES[name]
    return f"{value:.{figure.digits}%}" if figure.percent else f"{value:.{figure.digits}f}"


def _named(text: str) -> tuple[str, str]:
    name, equals, place = text.partition("=")
    if not (name and equals and place):
        raise argparse.ArgumentTypeError(f"expected NAME=DIR, got {text!r}")
    return name, place


def _count(text: str) -> int:
    if not text.isdecimal() or not int(text):
        raise argparse.ArgumentTypeError(f"expected a number of processes, got {text!r}")
    return int(text)


def _peers(text: str) -> list[str]:
    names = list(dict.fromkeys(text.split(",")))
    if not set(names) <= set(peers.PACKAGES):
        raise argparse.ArgumentTypeError(f"expected {','.join(peers.PACKAGES)}, got {text!r}")
    return names
