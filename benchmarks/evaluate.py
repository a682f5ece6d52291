"""``torch-vdm evaluate`` at scale: its overhead, start, page, workers, memory, and hostile files.

Budget: 20 minutes on two cores, a minute with ``--quick``. Each part runs the command as a user
does, in processes of their own; times are of the clock and, where other work would disturb them,
of the processors too.
"""

import csv
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple
from unittest import mock

import torch

from benchmarks.places import ROOT, shared_data
from benchmarks.record import blank_figure, caption, circumstances, measured_apart, save
from benchmarks.speed import status
from torch_vdm import VDM, Display, read_image, write_image
from torch_vdm.cli import ACCURACY, PPD, TRANSFORMS, WHITE
from torch_vdm.cli import main as command_line
from torch_vdm.evaluate import command
from torch_vdm.evaluate.frames import COLUMNS, EvaluationError, Job, read_manifest
from torch_vdm.evaluate.journal import NAME, Result
from torch_vdm.evaluate.judge import Bench
from torch_vdm.io import ImageError, load

# What is wanted: of the command's time over that of the metric and decoding alone; seconds to the
# first frame of a warm start, and until the page of 500 frames is there; seconds for which a file
# may be read. Source: what was asked of this command. Status: choice.
MOST_OVERHEAD, FIRST_FRAME, PAGE, LONGEST_READ = 1.3, 3.0, 2.0, 10.0

# Processes of the command, and of what it is compared with.
JOBS = 2

# Files that are damaged are no larger than so many bytes: many are read. Status: choice.
SMALL = 300_000


class Sizes(NamedTuple):
    """How much of everything."""

    pairs: int
    height: int
    width: int
    page: int
    frames: int
    many: tuple[int, ...]
    reads: int
    times: int


FULL = Sizes(64, 1080, 1920, 500, 120, (1000, 10_000, 100_000), 10_000, 3)
QUICK = Sizes(2, 60, 96, 8, 6, (100,), 100, 1)


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write evaluate.json, .md and .png to ``output``."""
    sizes = QUICK if quick else FULL
    result: dict[str, Any] = {**circumstances(), "sizes": sizes._asdict()}
    result["machine"]["threads"] = JOBS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        # The first warms what all others start from.
        for part, measure in (("overhead", _overhead), ("page", _page), ("workers", _workers)):
            place = folder / part
            place.mkdir()
            result[part] = measure(place, sizes)
            print(json.dumps({part: result[part]}), file=sys.stderr)
            shutil.rmtree(place)
        for part, arguments in (("many", sizes.many), ("fuzz", (sizes.reads,))):
            result[part] = []
            for number in arguments:
                place = folder / f"{part}{number}"
                place.mkdir()
                result[part].append(measured_apart("evaluate", part, place, number))
                print(json.dumps({part: result[part][-1]}), file=sys.stderr)
                shutil.rmtree(place)
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "evaluate", result, table)
        _plot(result, output / "evaluate.png")


def _pairs(folder: Path, count: int, height: int, width: int) -> None:
    """Write references and tests that differ by noise, 16 bits each, all of other content."""
    generator = torch.Generator().manual_seed(1)
    for name in ("reference", "test"):
        (folder / name).mkdir()
    down = torch.linspace(0.1, 1.0, height)[:, None].expand(3, height, width)
    for number in range(count):
        noise = 0.2 * torch.rand(2, 3, height, width, generator=generator)
        for name, image in zip(("reference", "test"), noise, strict=True):
            write_image(folder / name / f"{number:04}.exr", (down + image).half())


def _process(folder: Path, output: str, *more: str) -> "subprocess.Popen[bytes]":
    """Start the command; each of its processes computes on one thread."""
    words = ["evaluate", f"--reference={folder}/reference", f"--test=A={folder}/test"]
    return subprocess.Popen(
        [sys.executable, "-m", "torch_vdm", *words, f"--output={folder}/{output}", *more],
        # A warm start finds modules compiled; some machines are told not to keep them.
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": ""},
        stdout=subprocess.DEVNULL,
        cwd=ROOT,
    )


def _timed(folder: Path, output: str, *more: str) -> dict[str, float]:
    """Run the command; return seconds of all, of the processors, and to the first and last frame.

    A frame is there when its line is in the journal.
    """
    before, start = _processors(), time.perf_counter()
    process = _process(folder, output, *more)
    journal, times = folder / output / NAME, [0.0]
    while process.poll() is None:
        lines = journal.read_bytes().count(b"\n") if journal.exists() else 0
        times += [time.perf_counter() - start] * (lines + 1 - len(times))
        time.sleep(0.005)
    seconds = time.perf_counter() - start
    if process.returncode:
        raise RuntimeError(f"torch-vdm evaluate ended with status {process.returncode}")
    lines = journal.read_bytes().count(b"\n")
    times += [seconds] * (lines + 1 - len(times))
    return {
        "seconds": seconds,
        "processor_seconds": _processors() - before,
        "first": times[1],
        "last": times[-1],
        "frames": lines,
    }


def _processors() -> float:
    """Return the processor seconds of this process's children that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _overhead(folder: Path, sizes: Sizes) -> dict[str, float]:
    """Return what the command takes for large pairs, and what decoding and the metric alone.

    Medians over rounds of both.
    """
    _pairs(folder, sizes.pairs, sizes.height, sizes.width)
    rounds = [_round(folder, f"out{number}") for number in range(sizes.times)]
    found = {name: median(each[name] for each in rounds) for name in rounds[0]}
    found["ratio"] = found["seconds"] / found["alone_seconds"]
    found["processor_ratio"] = found["processor_seconds"] / found["alone_processor_seconds"]
    return found


def _round(folder: Path, output: str) -> dict[str, float]:
    found = _timed(folder, output, f"--jobs={JOBS}")
    frames = json.loads((folder / output / command.RESULTS).read_text())["frames"]
    found["metric_in_command"] = sum(frame["seconds"][0] for frame in frames)
    shutil.rmtree(folder / output)
    # The same work and nothing else, on as many processes that have begun before.
    before = _processors()
    names = sorted(path.name for path in (folder / "reference").iterdir())
    with ProcessPoolExecutor(JOBS, get_context("spawn")) as pool:
        list(pool.map(_warm, range(JOBS)))
        start = time.perf_counter()
        alone = list(pool.map(_alone, [folder] * len(names), names))
        found["alone_seconds"] = time.perf_counter() - start
    found["alone_processor_seconds"] = _processors() - before
    found["decoding"] = sum(each[0] for each in alone)
    found["metric"] = sum(each[1] for each in alone)
    return found


def _warm(_: int) -> None:
    torch.set_num_threads(1)
    image = torch.rand(1, 3, 64, 64)
    _metric()(image, image)


@cache
def _metric() -> VDM:
    """Return what the command judges by when nothing is asked."""
    return VDM(PPD, Display.linear(WHITE), transform=TRANSFORMS[ACCURACY["calibrated"]]())


def _alone(folder: Path, name: str) -> tuple[float, float]:
    """Decode and compare one pair; return the seconds of each."""
    start = time.perf_counter()
    reference, test = (read_image(folder / side / name)[None] for side in ("reference", "test"))
    middle = time.perf_counter()
    with torch.no_grad():
        _metric()(test, reference)
    return middle - start, time.perf_counter() - middle


def _page(folder: Path, sizes: Sizes) -> dict[str, float | None]:
    """Return seconds to the first of many frames, and until a browser has their page."""
    _pairs(folder, sizes.page, 64, 64)
    first = _timed(folder, "out")["first"]
    page = folder / "out" / command.REPORT
    return {
        "first": first,
        "frames": sizes.page,
        "bytes": page.stat().st_size,
        "seconds": _opened(page, sizes.times),
    }


def _opened(page: Path, times: int) -> float | None:
    """Return the seconds until a page is drawn, the median of some; None without a browser."""
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    try:
        from selenium.webdriver import Chrome, ChromeOptions
        from selenium.webdriver.chrome.service import Service
    except ImportError:
        binary = None
    if not binary or not driver:
        return None
    options = ChromeOptions()
    options.binary_location = binary
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(argument)
    browser = Chrome(options=options, service=Service(driver))
    seconds = []
    for _ in range(times):
        browser.get("about:blank")
        start = time.perf_counter()
        browser.get(page.as_uri())
        # The frame after the next is drawn with all of it.
        browser.execute_async_script(
            "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(done))"
        )
        seconds.append(time.perf_counter() - start)
    browser.quit()
    return median(seconds)


def _workers(folder: Path, sizes: Sizes) -> list[dict[str, float | str]]:
    """Return the seconds a frame of this process alone, and of one and two workers of Dask."""
    _pairs(folder, sizes.frames, min(sizes.height, 270), min(sizes.width, 480))
    rows: list[dict[str, float | str]] = []
    for number, name in enumerate(("no cluster", "1 worker", "2 workers")):
        words = ["--scheduler=local", f"--jobs={number}"] if number else []
        timed = _timed(folder, f"out{number}", *words)
        # Without the start, and without tables and page.
        rows.append(
            {
                "name": name,
                "seconds_a_frame": (timed["last"] - timed["first"]) / (timed["frames"] - 1),
                "processor_seconds": timed["processor_seconds"],
                "first": timed["first"],
            }
        )
    return rows


@dataclass
class Canned:
    """Stands for a `Judge`: what a frame costs without reading, comparing and writing it."""

    bench: Bench
    options: Any
    output: Path

    def __call__(self, job: Job, known: Result | None = None) -> Result:
        """Return a result of the usual size."""
        figures = dict.fromkeys(("max_jnd", "mean_jnd", "p95_jnd", "visible_fraction"), 0.5)
        return known or Result(
            frame=job.frame,
            test=job.test,
            key="0" * 64,
            figures={**figures, "mean_luminance_change": 0.01, "psnr": 31.25, "ssim": 0.875},
            size=(8, 8),
            counts=[2] * 35,
            regions=[(0, 0, 8, 8, 1.25)] * 8,
            pictures=dict.fromkeys(("reference", "test", "map"), "0" * 24),
            notes=["EXR is linear BT.709, and 1.0 is 100 cd/m2 (--white)"],
            seconds=(0.125, 0.25),
        )


def _many(folder: Path, count: int) -> dict[str, float]:
    """Return memory of the command's own process, and seconds, with frames that cost nothing."""
    from benchmarks.evaluate import Canned as Judge  # by a name that workers find

    manifest = folder / "frames.csv"
    with manifest.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows(
            (f"f/{n:06}", f"ref/{n:06}.exr", "A", f"a/{n:06}.exr") for n in range(count)
        )
    words = ["evaluate", f"--manifest={manifest}", f"--output={folder}/out"]
    begun, start = 1e3 * status("VmHWM"), time.perf_counter()
    with mock.patch.object(command, "Judge", Judge), redirect_stdout(sys.stderr):
        assert command_line([*words, "--scheduler=local", f"--jobs={JOBS}"]) == 0
    seconds = time.perf_counter() - start
    lines = (folder / "out" / command.TABLE).read_bytes().count(b"\n") - 1
    return {
        "frames": lines,
        "seconds": seconds,
        "begun_bytes": begun,
        "peak_bytes": 1e3 * status("VmHWM"),
    }


def _fuzz(folder: Path, count: int) -> dict[str, float]:
    """Read damaged copies of real files; return how that ended, how long one took, and memory."""
    files = list(_real(folder))
    rng = random.Random(1)
    for path in files:  # what every reader brings with it
        _read(path)
    begun = 1e3 * status("VmHWM")
    ends: Counter[str] = Counter()
    longest = 0.0
    for number in range(count):
        path = files[number % len(files)]
        damaged = folder / f"damaged{path.suffix}"
        damaged.write_bytes(_damaged(bytearray(path.read_bytes()), rng))
        start = time.perf_counter()
        ends[_read(damaged)] += 1
        longest = max(longest, time.perf_counter() - start)
    grown = 1e3 * status("VmHWM") - begun
    return {"files": len(files), **ends, "longest": longest, "grown_bytes": grown}


def _real(folder: Path) -> Iterable[Path]:
    """Yield files to damage: manifests, pictures of ours, and shared ones where they are."""
    import PIL.Image

    rows = "".join(f"hall/{n},r/{n}.exr,new,n/{n}.exr\n" for n in range(20))
    (folder / "m.csv").write_text(f"{','.join(COLUMNS)}\n{rows}")
    lines = (dict(zip(COLUMNS, row.split(","), strict=True)) for row in rows.split())
    (folder / "m.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    image = torch.rand(3, 40, 56, generator=torch.Generator().manual_seed(1))
    for name in ("i.exr", "i.png", "i.jpg"):
        write_image(folder / name, image)
    PIL.Image.new("RGB", (64, 48), (9, 99, 199)).save(folder / "p.jpg", progressive=True)
    PIL.Image.new("I;16", (64, 48), 999).save(folder / "p.png")
    yield from sorted(path for path in folder.iterdir() if path.is_file())
    for kind in ("exr", "ldr"):
        for path in sorted((shared_data() / kind).rglob("*")):
            fits = path.suffix.lower() in (".exr", ".png", ".jpg")
            if fits and path.is_file() and path.stat().st_size <= SMALL:
                yield path


def _damaged(data: bytearray, rng: random.Random) -> bytearray:
    """Return a file that is cut off, or has some bytes changed, or a piece moved."""
    kind = rng.choice(("cut", "flip", "header", "ones", "move"))
    if kind == "cut" or not data:
        return data[: rng.randrange(len(data) + 1)]
    for _ in range(rng.choice((1, 1, 2, 8))):
        at = rng.randrange(min(len(data), 400) if kind == "header" else len(data))
        if kind == "move":
            piece, there = data[at : at + rng.randrange(1, 64)], rng.randrange(len(data))
            data[there : there + len(piece)] = piece
        else:
            data[at] = 255 if kind == "ones" else rng.randrange(256)
    return data


def _read(path: Path) -> str:
    """Read a picture or a manifest; return how that ended, and never raise."""
    try:
        if path.suffix in (".csv", ".jsonl"):
            read_manifest(path)
        else:
            load(path, nonfinite="zero", negative="clip", quiet=True)
    except (ImageError, EvaluationError) as error:
        return "refused" if "\n" not in str(error) else "badly told"
    except Exception as error:  # what must not be
        print(f"{path.name}: {type(error).__name__}: {error}", file=sys.stderr)
        return "failed"
    return "read"


def _table(result: dict[str, Any]) -> str:
    sizes, overhead, page = result["sizes"], result["overhead"], result["page"]
    alone, workers = result["workers"][0]["seconds_a_frame"], result["workers"]
    opened = "no browser" if page["seconds"] is None else f"{page['seconds']:.2f} s"
    fuzz = result["fuzz"][0]
    wrong = sum(fuzz.get(name, 0) for name in ("failed", "badly told"))
    lines = [
        "# Many frames",
        "",
        caption(result),
        "",
        "| what | measured | wanted |",
        "|---|---|---|",
        f"| {sizes['pairs']} pairs of {sizes['width']} x {sizes['height']}, {JOBS} jobs: the "
        f"command, over decoding and the metric alone on {JOBS} processes | "
        f"{overhead['seconds']:.1f} s / {overhead['alone_seconds']:.1f} s = "
        f"{overhead['ratio']:.2f} | {MOST_OVERHEAD} |",
        f"| the same in processor seconds, starts and all | {overhead['processor_seconds']:.1f} / "
        f"{overhead['alone_processor_seconds']:.1f} = {overhead['processor_ratio']:.2f} | |",
        f"| of that alone: the metric, decoding | {overhead['metric']:.1f} s, "
        f"{overhead['decoding']:.1f} s | |",
        f"| first frame of a warm start | {page['first']:.2f} s | {FIRST_FRAME:g} s |",
        f"| the page of {page['frames']} frames ({page['bytes'] / 1e6:.2f} MB) is drawn | {opened} "
        f"| {PAGE:g} s |",
        f"| {sum(v for k, v in fuzz.items() if k in ('read', 'refused'))} damaged files read or "
        f"refused, others | {fuzz.get('read', 0)}, {fuzz.get('refused', 0)}, {wrong} | 0 others |",
        f"| the longest of them, and what memory grew by | {fuzz['longest']:.2f} s, "
        f"{fuzz['grown_bytes'] / 1e6:.0f} MB | {LONGEST_READ:g} s |",
        "",
        f"{sizes['frames']} frames of {min(sizes['width'], 480)} x {min(sizes['height'], 270)}, "
        "one thread each, between the first and the last:",
        "",
        "| | frames a second | overhead a frame |",
        "|---|---|---|",
    ]
    for number, row in enumerate(workers):
        over = row["seconds_a_frame"] * max(number, 1) - alone
        told = f"{1e3 * over:.0f} ms" if number else ""
        lines.append(f"| {row['name']} | {1.0 / row['seconds_a_frame']:.2f} | {told} |")
    lines += [
        "",
        f"Frames that cost nothing, through a Dask cluster of {JOBS} workers: what the command's "
        "own process holds, the scheduler in it.",
        "",
        "| frames | seconds | ms a frame | peak, MB | more than at the start, kB a frame |",
        "|---|---|---|---|---|",
    ]
    for row in result["many"]:
        grown = (row["peak_bytes"] - row["begun_bytes"]) / row["frames"] / 1e3
        each = 1e3 * row["seconds"] / row["frames"]
        lines.append(
            f"| {row['frames']} | {row['seconds']:.1f} | {each:.2f} "
            f"| {row['peak_bytes'] / 1e6:.0f} | {grown:.2f} |"
        )
    return "\n".join(lines) + "\n"


def _plot(result: dict[str, Any], path: Path) -> None:
    figure = blank_figure(8.0, 3.2)
    left, right = figure.subplots(1, 2)
    speeds = [1.0 / row["seconds_a_frame"] for row in result["workers"]]
    left.plot([1, 2], speeds[1:], marker="o", label="Dask")
    left.plot([1, 2], [speeds[0], 2.0 * speeds[0]], "--", label="no cluster, and twice that")
    left.set(xlabel="workers", ylabel="frames a second", xticks=[1, 2])
    frames = [row["frames"] for row in result["many"]]
    right.plot(frames, [row["peak_bytes"] / 1e6 for row in result["many"]], marker="o")
    right.set(xlabel="frames", ylabel="peak memory, MB", xscale="log")
    for axis in (left, right):
        axis.set_ylim(0.0, 1.1 * axis.dataLim.y1)
        axis.spines[["top", "right"]].set_visible(False)
    left.legend(frameon=False)
    figure.savefig(path)


def _measured(arguments: Sequence[str]) -> dict[str, float]:
    """Measure one part in this process."""
    part, folder, number = arguments
    return {"many": _many, "fuzz": _fuzz}[part](Path(folder), int(number))


if __name__ == "__main__":
    print(json.dumps(_measured(sys.argv[1:])))
