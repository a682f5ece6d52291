"""Time and memory of the metric beside kornia's SSIM, in one run.

Times are medians of interleaved runs: every round runs each contender once, so that whatever else
the machine does strikes all of them. Each is in a process of its own, as its users have it, for the
first metric of this package has the C library keep freed memory (`torch_vdm.run.memory`), which
serves whatever else the process does: SSIM is also measured so. Memory and compile times are those
of child processes, which begin with nothing. Two threads, sRGB noise in [0, 1], float32.
"""

import ctypes
import itertools
import json
import math
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.record import blank_figure, caption, circumstances, in_turn, measured_apart, save
from torch_vdm import VDM, VDMLoss
from torch_vdm.run.memory import keep_freed_memory

THREADS = 2
FULL_HD = (1080, 1920)
SIZES = ((512, 512), (1024, 1024), FULL_HD, (2160, 3840))
QUICK_SIZES = ((128, 128), (192, 256))

# What a training step has.
BATCH, PATCH = 4, (256, 256)

# How often all sizes are measured in turn: their times are compared with one another, and the
# machine changes between minutes. And the pixels that each size is given in a round, at least.
ROUNDS, A_ROUND = 45, 2**21

Contender = Callable[[Tensor, Tensor], Tensor]


def ssim() -> Contender:
    """Kornia's SSIM map with its window of 11 pixels."""
    from kornia.metrics import ssim

    return lambda test, reference: ssim(test, reference, 11)


def eager() -> Contender:
    """The default metric."""
    return VDM()


def compiled() -> Contender:
    """The default metric by its fast route."""
    return VDM().compile()


def paper() -> Contender:
    """The paper's observer."""
    return VDM.paper()


def ssim_loss() -> Contender:
    """Kornia's SSIM loss with its window of 11 pixels."""
    from kornia.losses import SSIMLoss

    loss = SSIMLoss(11)
    return lambda test, reference: loss(test, reference)


def eager_loss() -> Contender:
    """The default loss."""
    return VDMLoss()


def checkpointed_loss() -> Contender:
    """The default loss, which computes most of its forward pass again in the backward pass."""
    return VDMLoss(checkpoint=True)


def compiled_loss() -> Contender:
    """The default loss by its fast route."""
    return VDMLoss().compile()


def torchmetrics_ssim() -> Contender:
    """Torchmetrics' SSIM with a window of 11 pixels, as a loss."""
    from torchmetrics.functional.image import structural_similarity_index_measure as similarity

    def loss(test: Tensor, reference: Tensor) -> Tensor:
        value = similarity(test, reference, kernel_size=11, data_range=1.0)
        assert isinstance(value, Tensor)
        return 1.0 - value

    return loss


def piq_ssim() -> Contender:
    """The SSIM loss of piq with its window of 11 pixels."""
    from piq import SSIMLoss

    loss = SSIMLoss()
    return lambda test, reference: loss(test, reference)


def pytorch_msssim() -> Contender:
    """The SSIM of pytorch-msssim with its window of 11 pixels, as a loss."""
    from pytorch_msssim import ssim

    return lambda test, reference: 1.0 - ssim(test, reference, data_range=1.0)


def kept(maker: Callable[[], Contender]) -> Contender:
    """Return a contender in a process that keeps freed memory, as ours does."""
    keep_freed_memory()
    return maker()


FORWARD: dict[str, Callable[[], Contender]] = {
    "kornia SSIM": ssim,
    "kornia SSIM, memory kept": partial(kept, ssim),
    "VDM": eager,
    "VDM compiled": compiled,
    "VDM paper": paper,
}
BACKWARD: dict[str, Callable[[], Contender]] = {
    "kornia SSIM loss": ssim_loss,
    "kornia SSIM loss, memory kept": partial(kept, ssim_loss),
    "VDMLoss": eager_loss,
    "VDMLoss checkpoint": checkpointed_loss,
    "VDMLoss compiled": compiled_loss,
}
# Of other packages, in the extra "peers"; one that is missing is named. Slower metrics, cvvdp and
# FLIP among them, are timed by the benchmark "accuracy".
PEERS = {
    "torchmetrics SSIM loss": torchmetrics_ssim,
    "piq SSIM loss": piq_ssim,
    "pytorch-msssim loss": pytorch_msssim,
}
CONTENDERS = FORWARD | BACKWARD
COMPILED = ("VDM compiled", "VDMLoss compiled")

# Peaks of memory: as the package has it, and where the C library gives freed memory back, so that
# what it keeps between two parts of a call is not counted.
PEAKS: dict[str, dict[str, str]] = {
    "peak_extra_megabytes": {},
    "peak_returned_megabytes": {"MALLOC_MMAP_THRESHOLD_": "131072"},
}

# What a smoke test takes.
QUICK_FORWARD, QUICK_BACKWARD = ("kornia SSIM", "VDM"), ("kornia SSIM loss", "VDMLoss")


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write speed.json, speed.md and speed.png to ``output``."""
    torch.set_num_threads(THREADS)
    sizes = QUICK_SIZES if quick else SIZES
    size = sizes[-1] if quick else FULL_HD
    rounds = 2 if quick else 9
    result: dict[str, Any] = {**circumstances(), "size": size, "rounds": rounds}
    forward, backward = (QUICK_FORWARD, QUICK_BACKWARD) if quick else (FORWARD, BACKWARD)
    result["forward_seconds"] = _interleaved(list(forward), size, rounds)
    result["backward_seconds"] = _interleaved(list(backward), size, rounds)
    installed = [name for name, maker in PEERS.items() if _installed(maker)]
    result["missing"] = [name for name in PEERS if name not in installed]
    batch = (BATCH, *(QUICK_SIZES[0] if quick else PATCH))
    result["batch"] = batch
    result["batch_seconds"] = _interleaved([*backward, *installed], batch[1:], rounds, BATCH)
    result["forward_seconds_by_size"] = _by_size(sizes, 2 if quick else ROUNDS)
    measured = [*forward, *backward]
    for peak, environment in PEAKS.items():
        result[peak] = {
            name: measured_apart("speed", "memory", name, *size, environment=environment)[
                "megabytes"
            ]
            for name in measured
        }
    # Compiled anew, which a smoke test has no time for.
    result["compile_seconds"] = {} if quick else _compile_times(size, COMPILED)
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "speed", result, table)
        _plot(result, output / "speed.png")


def images(size: tuple[int, int], batch: int = 1) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    reference = torch.rand(batch, 3, *size, generator=generator)
    noise = 0.05 * torch.randn(reference.shape, generator=generator)
    return (reference + noise).clamp(0.0, 1.0), reference


def _installed(maker: Callable[[], Contender]) -> bool:
    try:
        maker()
    except ImportError:
        return False
    return True


def _once(name: str, contender: Contender, test: Tensor, reference: Tensor) -> float:
    """Return the seconds of one call."""
    start = time.perf_counter()
    if name in FORWARD:
        with torch.no_grad():
            contender(test, reference)
    else:
        contender(test.clone().requires_grad_(), reference).backward()
    return time.perf_counter() - start


def _interleaved(
    names: Sequence[str], size: tuple[int, int], rounds: int, batch: int = 1
) -> dict[str, float]:
    """Return each contender's median seconds, in interleaved runs."""
    seconds: dict[str, list[float]] = {name: [] for name in names}
    with ExitStack() as stack:
        once = {name: stack.enter_context(_served(name, size, batch)) for name in names}
        for number in range(rounds + 2):
            for name in in_turn(names, number):
                taken = once[name]()
                if number >= 2:  # the first rounds compile and fill caches
                    seconds[name].append(taken)
    return {name: statistics.median(values) for name, values in seconds.items()}


@contextmanager
def _served(
    name: str, size: tuple[int, int], batch: int
) -> Generator[Callable[[], float], None, None]:
    """Have a contender in a process of its own; give what returns the seconds of a call there."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, name, size, batch), daemon=True)
    process.start()
    theirs.close()

    def once() -> float:
        ours.send(None)
        return float(ours.recv())

    try:
        yield once
    finally:
        ours.close()
        process.join()


def _serve(connection: Connection, name: str, size: tuple[int, int], batch: int) -> None:
    torch.set_num_threads(THREADS)
    contender, pair = (CONTENDERS | PEERS)[name](), images(size, batch)
    with suppress(EOFError):  # the end
        while True:
            connection.recv()
            connection.send(_once(name, contender, *pair))


def _by_size(sizes: Sequence[tuple[int, int]], rounds: int) -> dict[str, dict[str, float]]:
    """Return the median seconds of the metric at each size, all sizes in every round.

    A slow moment of the machine then strikes all of them. Small images are taken several times a
    round, for a moment strikes them harder.
    """
    contenders = {name: FORWARD[name]() for name in ("VDM", "VDM compiled")}
    pairs = {size: images(size) for size in sizes}
    cells = list(itertools.product(sizes, contenders))
    seconds: dict[tuple[tuple[int, int], str], list[float]] = {cell: [] for cell in cells}
    for number in range(rounds + 2):
        for size, name in cells:
            calls = range(max(1, A_ROUND // math.prod(size)))
            taken = [_once(name, contenders[name], *pairs[size]) for _ in calls]
            if number >= 2:  # as above
                seconds[size, name] += taken
    return {
        f"{size[1]}x{size[0]}": {
            name: statistics.median(seconds[size, name]) for name in contenders
        }
        for size in sizes
    }


def _compile_times(size: tuple[int, int], names: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Return the seconds of the first compiled calls in a new process, cold and from the cache.

    Torch's modules are there as bytecode, as pip leaves them at installation.
    """
    times: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as bytecode:
        # Not only where this installation has it, or where Python may write it.
        common = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": bytecode}

        def seconds(name: str, cache: str) -> float:
            environment = common | {"TORCHINDUCTOR_CACHE_DIR": cache}
            return measured_apart("speed", "first", name, *size, environment=environment)["seconds"]

        with tempfile.TemporaryDirectory() as cache:
            seconds(names[-1], cache)  # writes the bytecode
        for name in names:
            with tempfile.TemporaryDirectory() as cache:
                states = "cold", "from the cache"
                times[name] = {state: seconds(name, cache) for state in states}
    return times


def _measure(what: str, name: str, size: tuple[int, int]) -> dict[str, float]:
    """Return the seconds of a first call, or its peak of memory over what stood before."""
    torch.set_num_threads(THREADS)
    contender = CONTENDERS[name]()
    test, reference = images(size)
    if what == "first":
        return {"seconds": _once(name, contender, test, reference)}
    # Imports, thread pools and compilation are not the metric's working memory.
    _once(name, contender, *images((96, 160)))
    return {"megabytes": peak_megabytes(lambda: _once(name, contender, test, reference))}


def peak_megabytes(call: Callable[[], object]) -> float:
    """Return the memory that a call takes at most over what the process had before, in MB."""
    # What the C library keeps of earlier calls would be used again and not be seen.
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = status("VmRSS")
    call()
    return (status("VmHWM") - before) / 1e3


def status(field: str) -> float:
    """Return a field of /proc/self/status in kilobytes of 1000 bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field):
            return float(line.split()[1]) * 1.024
    raise RuntimeError(f"no {field} in /proc/self/status: memory is measured on Linux only")


def _table(result: dict[str, Any]) -> str:
    height, width = result["size"]
    lines = [
        f"# Speed and memory, {width} x {height}",
        "",
        caption(result),
        "",
        "| | seconds | to kornia | peak extra MB | the same, freed memory not kept |",
        "|---|---|---|---|---|",
    ]
    for key, yardstick in (
        ("forward_seconds", "kornia SSIM"),
        ("backward_seconds", "kornia SSIM loss"),
    ):
        for name, seconds in result[key].items():
            ratio = seconds / result[key][yardstick]
            memory = " | ".join(f"{result[peak].get(name, math.nan):.0f}" for peak in PEAKS)
            lines.append(f"| {name} | {seconds:.3f} | {ratio:.2f} | {memory} |")
    lines += ["", "Losses: forward and backward.", ""]
    batch = " x ".join(map(str, (result["batch"][0], 3, *result["batch"][1:])))
    lines += [f"Forward and backward, {batch}:", "", "| | seconds | to kornia |", "|---|---|---|"]
    for name, seconds in result["batch_seconds"].items():
        ratio = seconds / result["batch_seconds"]["kornia SSIM loss"]
        lines.append(f"| {name} | {seconds:.3f} | {ratio:.2f} |")
    if result["missing"]:
        lines += ["", f"Not installed: {', '.join(result['missing'])}."]
    lines += ["", "| size | VDM, ns a pixel | VDM compiled, ns a pixel |", "|---|---|---|"]
    for size, seconds in result["forward_seconds_by_size"].items():
        wide, high = map(int, size.split("x"))
        cells = " | ".join(f"{1e9 * value / (wide * high):.0f}" for value in seconds.values())
        lines.append(f"| {size} | {cells} |")
    if result["compile_seconds"]:
        lines += [
            "",
            "Of a new process that has loaded torch, without compiled code and with that on disk:",
            "",
            "| first call | cold, s | from the cache, s |",
            "|---|---|---|",
        ]
    for name, states in result["compile_seconds"].items():
        lines.append(f"| {name} | {states['cold']:.1f} | {states['from the cache']:.1f} |")
    return "\n".join(lines) + "\n"


def _plot(result: dict[str, Any], path: Path) -> None:
    figure = blank_figure(8.0, 3.6)
    bars, curve = figure.subplots(1, 2)
    ratios = {
        name: seconds / result["forward_seconds"]["kornia SSIM"]
        for name, seconds in result["forward_seconds"].items()
    }
    shown = bars.barh(list(ratios), list(ratios.values()), color="#3b5b92")
    bars.bar_label(shown, fmt="%.2f", padding=3)
    bars.set_xlim(0.0, 1.25 * max(ratios.values()))
    bars.invert_yaxis()
    bars.set_xlabel("time, kornia's SSIM = 1")
    height, width = result["size"]
    bars.set_title(f"forward, {width} x {height}", fontsize=10)
    for name in ("VDM", "VDM compiled"):
        points = []
        for size, seconds in result["forward_seconds_by_size"].items():
            wide, high = map(int, size.split("x"))
            points.append((wide * high / 1e6, 1e9 * seconds[name] / (wide * high)))
        curve.plot(*zip(*points, strict=True), marker="o", label=name)
    curve.set_xscale("log")
    sizes = list(result["forward_seconds_by_size"])
    areas = [math.prod(map(int, size.split("x"))) / 1e6 for size in sizes]
    curve.set_xticks(areas, labels=[f"{area:.2g}" for area in areas])
    curve.minorticks_off()
    curve.set_ylim(bottom=0.0)
    curve.set_xlabel("megapixels")
    curve.set_ylabel("nanoseconds a pixel")
    curve.set_title("time against size", fontsize=10)
    curve.legend(frameon=False, fontsize=9)
    for axis in (bars, curve):
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)


if __name__ == "__main__":
    print(json.dumps(_measure(sys.argv[1], sys.argv[2], (int(sys.argv[3]), int(sys.argv[4])))))
