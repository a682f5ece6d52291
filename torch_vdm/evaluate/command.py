"""``torch-vdm evaluate``: from options to a folder with results and a report."""

import argparse
import importlib.util
import io
import sys
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_vdm import __version__, cluster
from torch_vdm.evaluate import journal, page, peers, statistics, tables, workers
from torch_vdm.evaluate.cluster import results as on_cluster
from torch_vdm.evaluate.frames import (
    EvaluationError,
    Job,
    Matched,
    match,
    natural,
    read_manifest,
)
from torch_vdm.evaluate.journal import Journal, Result
from torch_vdm.evaluate.judge import Bench, Judge, settings
from torch_vdm.evaluate.statistics import Paired, counted
from torch_vdm.io import check_target
from torch_vdm.report import plain_console

RESULTS, TABLE, PARQUET, REPORT = "results.json", "table.csv", "table.parquet", "report.html"

# Figures by which tests are compared with one another, and the words for them.
COMPARED = {
    "max_jnd": "Maximum",
    "p95_jnd": "95th percentile",
    "mean_jnd": "Mean",
    "flicker_max_jnd": "Flicker, maximum",
}

# Figures that the terminal has no room for; they are in the table that is written.
NOT_IN_TERMINAL = ("mean_luminance_change", "flicker_mean_jnd", "flicker_visible_fraction")

# Skipped frames that are named on the terminal. Status: choice.
NAMED = 5


class Outcome(NamedTuple):
    """What is said at the end, and whether a maximum was over ``--fail-above``."""

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
    known = _prepared(options)
    results = _worked_through(options, bench, matched, known)
    compared = _compared(matched.tests, results)
    summary = _summary(matched.tests, results, options.fail_above)
    output: Path = options.output
    told = {
        "version": __version__,
        "reference": options.reference,
        "tests": ", ".join(f"{name}={place}" for name, place in options.test or ()),
        "manifest": None if options.manifest is None else str(options.manifest),
        "fail_above": options.fail_above,
        **settings(options),
    }
    tables.write_json(output / RESULTS, told, summary, compared, results)
    tables.write_csv(output / TABLE, results)
    if options.parquet:
        tables.write_parquet(output / PARQUET, results)
    if options.junit:
        tables.write_junit(options.junit, results, options.fail_above)
    sentences = [pair.sentence(COMPARED[pair.figure]) for pair in compared]
    page.write(output / REPORT, matched.tests, results, sentences, told, assumptions)
    _check_any(results)
    exceeded = [result for result in results if tables.exceeds(result, options.fail_above)]
    return Outcome(_text(options, matched.tests, results, sentences, exceeded), bool(exceeded))


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
    """Refuse, before anything is computed, what would fail for a package or has no meaning."""
    if options.jobs and options.scheduler not in (None, cluster.LOCAL):
        raise EvaluationError(
            "expected --jobs or the --scheduler of a cluster, which has its own workers, got both; "
            "leave --jobs out"
        )
    missing = peers.missing(options.peers)
    if missing:
        raise EvaluationError(f"--peers {','.join(missing)}: not installed; {peers.EXTRA}")
    if options.parquet and importlib.util.find_spec("pyarrow") is None:
        raise EvaluationError(
            "--parquet: pyarrow is not installed; pip install 'torch-vdm[report]'"
        )
    if options.scheduler and importlib.util.find_spec("distributed") is None:
        raise EvaluationError(f"--scheduler: Dask is not installed; {cluster.EXTRA}")


def _prepared(options: argparse.Namespace) -> dict[tuple[str, str], Result]:
    """Make the output folder, and return what is known in it."""
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
    return journal.read(output)


def _worked_through(
    options: argparse.Namespace,
    bench: Bench,
    matched: Matched,
    known: dict[tuple[str, str], Result],
) -> list[Result]:
    """Return the results of all frames, in their order; each is in the journal as it comes."""
    results = {
        (missing.frame, missing.test): Result(
            frame=missing.frame, test=missing.test, skipped=missing.why
        )
        for missing in matched.missing
    }
    judge = Judge(bench, options, options.output)
    with (
        Journal(options.output) as lines,
        closing(_coming(judge, matched.jobs, known, options)) as coming,
        _progress(matched.jobs) as advance,
    ):
        for key, result in results.items():
            _add(lines, known.get(key), result)
        try:
            for result in coming:
                key = result.frame, result.test
                _add(lines, known.get(key), result)
                results[key] = result
                advance()
        except KeyboardInterrupt:
            print(f"what is done is kept in {options.output}; --resume goes on", file=sys.stderr)
            raise
    place = {test: number for number, test in enumerate(matched.tests)}
    return [
        results[key] for key in sorted(results, key=lambda key: (natural(key[0]), place[key[1]]))
    ]


def _coming(
    judge: Judge,
    jobs: Sequence[Job],
    known: dict[tuple[str, str], Result],
    options: argparse.Namespace,
) -> Generator[Result, None, None]:
    """Yield the results of jobs as they come, from a cluster or from processes of this machine."""
    if options.scheduler is None:
        return workers.results(judge, jobs, known, options.jobs or 1)
    return on_cluster(judge, jobs, known, options.scheduler, options.jobs)


def _add(lines: Journal, known: Result | None, result: Result) -> None:
    """Add a result to the journal, unless the journal has it."""
    if known is None or known.line() != result.line():
        lines.add(result)


@contextmanager
def _progress(jobs: Sequence[Job]) -> Iterator[Any]:
    """Show a bar with the time left on a terminal; yield what moves it on by one."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    console = Console(stderr=True)
    bar = Progress(
        "comparing",
        BarColumn(),
        MofNCompleteColumn(),
        "left:",
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task("", total=len(jobs))
        yield lambda: bar.advance(task)


def _compared(tests: Sequence[str], results: Sequence[Result]) -> list[Paired]:
    """Compare every two tests by every figure that both have."""
    values: dict[tuple[str, str], dict[str, float]] = {}
    for result in results:
        for name in COMPARED:
            value = result.figures.get(name)
            if value is not None:
                values.setdefault((name, result.test), {})[result.frame] = value
    found = []
    for one, other in combinations(tests, 2):
        for name in COMPARED:
            first, second = values.get((name, one), {}), values.get((name, other), {})
            common = [(first[frame], second[frame]) for frame in first if frame in second]
            if common:
                found.append(statistics.compare(one, other, name, common))
    return found


def _summary(
    tests: Sequence[str], results: Sequence[Result], fail_above: float | None
) -> dict[str, object]:
    """Return, for each test, how many frames were compared, and medians and extremes."""
    told: dict[str, object] = {}
    for test in tests:
        of_test = [result for result in results if result.test == test]
        done = [result for result in of_test if not result.skipped]
        told[test] = {
            "compared": len(done),
            "skipped": len(of_test) - len(done),
            "exceeded": sum(tables.exceeds(result, fail_above) for result in done),
            "figures": {
                name: _spread([v for r in done if (v := r.figures.get(name)) is not None])
                for name in tables.present(done)
            },
        }
    return {"tests": told}


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"median": float(np.median(values)), "least": min(values), "most": max(values)}


def _check_any(results: Sequence[Result]) -> None:
    skipped = [result for result in results if result.skipped]
    if len(skipped) == len(results):
        first = skipped[0]
        raise EvaluationError(
            f"nothing could be compared: {counted(len(skipped), 'comparison')} skipped, the first "
            f"is {first.frame} of {first.test}: {first.skipped}"
        )


def _text(
    options: argparse.Namespace,
    tests: Sequence[str],
    results: Sequence[Result],
    sentences: Sequence[str],
    exceeded: Sequence[Result],
) -> str:
    """Return what is said on the terminal at the end."""
    text = io.StringIO()
    console = plain_console(text, 100)
    console.print(_table(tests, results))
    for sentence in sentences:
        console.print(sentence, style="bold")
    skipped = [result for result in results if result.skipped]
    if skipped:
        console.print(f"Skipped {len(skipped)} of {counted(len(results), 'comparison')}:")
        for result in skipped[:NAMED]:
            console.print(f"  {result.frame} of {result.test}: {result.skipped}")
        if len(skipped) > NAMED:
            console.print(f"  and {len(skipped) - NAMED} more, in {TABLE}")
    if exceeded:
        worst = max(exceeded, key=lambda result: result.figures["max_jnd"] or 0.0)
        console.print(
            f"Over {options.fail_above:g} JND: {counted(len(exceeded), 'comparison')}; the worst "
            f"is {worst.frame} of {worst.test}, {worst.figures['max_jnd']:.2f} JND"
        )
    console.print(f"written: {options.output / REPORT}", style="dim")
    return text.getvalue()


def _table(tests: Sequence[str], results: Sequence[Result]) -> Any:
    """Return a table of medians over the frames, a line for each test."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    names = [name for name in tables.present(results) if name not in NOT_IN_TERMINAL]
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, title="Median over the frames")
    for heading in ("test", "frames", "worst", *(tables.FIGURES[name].label for name in names)):
        grid.add_column(heading, justify="left" if heading == "test" else "right")
    for test in tests:
        done = [result for result in results if result.test == test and not result.skipped]
        cells = [test, str(len(done))]
        largest = [value for r in done if (value := r.figures["max_jnd"]) is not None]
        cells.append(f"{max(largest):.2f}" if largest else "")
        for name in names:
            values = [value for r in done if (value := r.figures.get(name)) is not None]
            cells.append(shown(name, float(np.median(values))) if values else "")
        grid.add_row(*(Text(cell) for cell in cells))
    return grid


def shown(name: str, value: float) -> str:
    """Return a figure with the digits that it is shown with."""
    figure = tables.FIGURES[name]
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
