"""Time, memory and equality on a CUDA device, beside other metrics on the same.

Maps and training steps, eager, compiled, with the kernel of Triton and replayed from a CUDA graph;
each round runs every contender once, and the device has done all of it before the clock stops. With
``--quick`` and without such a device it is a smoke test on the processor, where nothing is captured
and there is no kernel.

LPIPS is measured where the package ``lpips`` and its weights are.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import peers
from benchmarks.launches import of_a_gpu, step
from benchmarks.record import blank_figure, caption, circumstances, save
from benchmarks.rungs import RUNGS
from benchmarks.scenes import STILL_LIFE, scene_file, sized
from benchmarks.speed import BATCH, FULL_HD, PATCH, images
from benchmarks.speed import ssim as kornia_ssim
from benchmarks.speed import ssim_loss as kornia_ssim_loss
from sampling.renderers.llvm import LLVMError, find_llvm
from sampling.renderers.mitsuba import MitsubaRenderer, SceneError
from torch_vdm import VDM, VDMLoss

SIZES = ((256, 256), (512, 512), FULL_HD, (2160, 3840))
QUICK_SIZES = ((176, 192),)

# Nothing is read back, which a graph cannot, and nothing left out.
OPTIONS: dict[str, Any] = {"nonfinite": "mask", "effects": "full"}

# What is replayed from a CUDA graph too.
BY_KERNEL = "kernel", "compiled, kernel"
CAPTURED = (*RUNGS, *(f"{of}, {how}" for of in ("fast", "VDMLoss") for how in BY_KERNEL), "VDMLoss")

# Calls of every contender, and those before, which compile and allocate.
ROUNDS, FIRST = 30, 5

# The largest difference between the two devices' maps, as a share of the larger: in float32.
EQUAL = 1e-4

# Of the renderer: pixels a side, and samples a pixel.
SIDE, SPP = 512, 64

Function = Callable[[Tensor, Tensor], Any]


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the tables, and write gpu.json, gpu.md and gpu.png to ``output``."""
    if not (torch.cuda.is_available() or quick):
        raise SystemExit(
            "benchmarks gpu: expected a CUDA device, got none; run it where there is one, or with "
            "--quick as a smoke test on the processor"
        )
    find_llvm()  # before anything imports Mitsuba
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    rounds = 2 if quick else ROUNDS
    result: dict[str, Any] = {**circumstances(), "card": _card(device), "rounds": rounds}
    sizes = QUICK_SIZES if quick else SIZES
    batch = (BATCH, *(QUICK_SIZES[0] if quick else PATCH))
    result["missing"] = {}
    precisions = torch.float32, torch.bfloat16
    with torch.no_grad():
        maps = _maps(device, quick, result["missing"])
        result["maps"] = [
            _row(maps, (1, *size), dtype, device, rounds) for dtype in precisions for size in sizes
        ]
    steps = _steps(device, quick)
    result["steps"] = [
        _row(steps, shape, dtype, device, rounds)
        for dtype in precisions
        for shape in (batch, (1, *sizes[-1 if quick else -2]))
    ]
    metrics = _metrics(device).items()
    result["equal"] = {name: _equality(options, device, sizes[0]) for name, options in metrics}
    result["waits"] = {name: _waits(options, device) for name, options in metrics}
    result["renderer"] = _renderer(64 if quick else SIDE, 4 if quick else SPP)
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "gpu", result, table)
        _plot(result, output / "gpu.png")


def _card(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "none: the processor"


# What is timed.


def _metrics(device: torch.device) -> dict[str, dict[str, Any]]:
    """Return the options of our metrics by name; kernels are for a GPU alone."""
    found: dict[str, dict[str, Any]] = {
        name: {**OPTIONS, "transform": transform} for name, transform in RUNGS.items()
    }
    if device.type == "cuda":
        for how in BY_KERNEL:
            schedule = of_a_gpu(False, kernel=True, compiled=how != "kernel")
            found[f"fast, {how}"] = {**OPTIONS, "schedule": schedule}
    return found


def _maps(device: torch.device, quick: bool, missing: dict[str, str]) -> dict[str, Function]:
    """Return metrics by name; those that are not here are named in ``missing``."""
    found: dict[str, Function] = {"kornia SSIM": kornia_ssim()}
    others: dict[str, Callable[[], Function]] = {
        "MS-SSIM": lambda: peers.PEERS["MS-SSIM"]().timed,
        "LPIPS": lambda: _lpips(device),
        "ColorVideoVDP": lambda: _cvvdp(device),
    }
    for name, make in others.items():
        try:
            found[name] = make()
        except (ImportError, OSError) as error:
            missing[name] = f"not there: {error}"
    for name, options in _metrics(device).items():
        found[name] = VDM(**options).to(device)
    if not quick:  # a smoke test would compile for half a minute
        found["fast, compiled"] = VDM(**OPTIONS).to(device).compile()
    return found


def _steps(device: torch.device, quick: bool) -> dict[str, Function]:
    """Return losses with their gradients."""
    losses: dict[str, Function] = {
        "kornia SSIM loss": kornia_ssim_loss(),
        "VDMLoss": VDMLoss(**OPTIONS).to(device),
    }
    if device.type == "cuda":
        for how in BY_KERNEL:
            schedule = of_a_gpu(True, kernel=True, compiled=how != "kernel")
            losses[f"VDMLoss, {how}"] = VDMLoss(schedule=schedule, **OPTIONS).to(device)
    if not quick:
        fast = VDMLoss(**OPTIONS).to(device).compile()
        losses["VDMLoss, compiled"] = fast
    return {name: step(loss) for name, loss in losses.items()}


def _lpips(device: torch.device) -> Function:
    import lpips

    network = lpips.LPIPS(net="alex", verbose=False).to(device)
    return lambda test, reference: network(2.0 * test - 1.0, 2.0 * reference - 1.0)


def _cvvdp(device: torch.device) -> Function:
    import pycvvdp

    metric = pycvvdp.cvvdp(display_name="standard_4k", heatmap="raw", quiet=True, device=device)
    return lambda test, reference: metric.predict(test, reference, dim_order="BCHW")[0]


def _captured(call: Callable[[], Any]) -> Function:
    """Return what replays a call, whose images stay where they are, from a CUDA graph."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(3):  # what is kept between calls is made outside of the graph
            call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        kept = call()

    def replay(test: Tensor, reference: Tensor) -> Any:
        del test, reference
        graph.replay()
        return kept

    return replay


# How.


def _row(
    named: dict[str, Function],
    shape: tuple[int, int, int],
    dtype: torch.dtype,
    device: torch.device,
    rounds: int,
) -> dict[str, Any]:
    """Return each contender's median seconds, and the memory that it takes at most."""
    batch, *size = shape
    pair = images((size[0], size[1]), batch)
    test, reference = (image.to(device, dtype) for image in pair)
    functions: dict[str, Function] = {}
    megabytes: dict[str, float] = {}
    failed: dict[str, str] = {}
    # A graph's images stay where they are.
    graphs = {
        f"{name}, captured": partial(_captured, partial(named[name], test, reference))
        for name in CAPTURED
        if name in named and device.type == "cuda"
    }
    for name in (*named, *graphs):
        try:
            function = graphs[name]() if name in graphs else named[name]
            with _peak(device) as peak:
                for _ in range(min(FIRST, rounds)):
                    function(test, reference)
        except (RuntimeError, ValueError) as error:  # of a size or a precision
            failed[name] = str(error).splitlines()[0]
            continue
        functions[name], megabytes[name] = function, peak[0]
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            _wait(device)
            start = time.perf_counter()
            function(test, reference)
            _wait(device)
            seconds[name].append(time.perf_counter() - start)
    return {
        "shape": [batch, 3, *size],
        "precision": str(dtype).removeprefix("torch."),
        "seconds": {name: statistics.median(taken) for name, taken in seconds.items()},
        "peak_megabytes": megabytes,
        "failed": failed,
    }


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def _peak(device: torch.device) -> Iterator[list[float]]:
    """Measure what is allocated at most over what was; of the processor nothing is known here."""
    found = [float("nan")]
    if device.type != "cuda":
        yield found
        return
    _wait(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    yield found
    _wait(device)
    found[0] = (torch.cuda.max_memory_allocated(device) - before) / 1e6


# What must hold.


def _equality(options: dict[str, Any], device: torch.device, size: tuple[int, int]) -> float:
    """Return the largest difference between this device's map and the processor's, as a share."""
    pair = images(size)
    with torch.no_grad():
        expected = VDM(**{**options, "schedule": None})(*pair)
        found = VDM(**options).to(device)(*(image.to(device) for image in pair)).cpu()
    return float(((found - expected).abs() / expected.clamp_min(1e-3)).amax())


def _waits(options: dict[str, Any], device: torch.device) -> bool:
    """Return whether a map makes the processor wait for the device."""
    if device.type != "cuda":
        return False
    metric = VDM(**options).to(device)
    pair = [image.to(device) for image in images((128, 128))]
    with torch.no_grad():
        metric(*pair)
        torch.cuda.set_sync_debug_mode("error")
        try:
            metric(*pair)
        except RuntimeError:
            return True
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return False


def _renderer(side: int, spp: int) -> dict[str, Any]:
    """Return the million samples a second of the renderer's variants that can run here."""
    found: dict[str, Any] = {}
    for variant in ("cuda_ad_rgb", "llvm_ad_rgb"):
        try:
            renderer = MitsubaRenderer(
                scene_file(STILL_LIFE), sized(STILL_LIFE, side), variant=variant
            )
        except (SceneError, LLVMError) as error:
            found[variant] = str(error).splitlines()[0]
            continue
        pixels = np.arange(side * side)
        taken = []
        for number in range(3):
            start = time.perf_counter()
            renderer.sample(pixels, 0 * pixels + number * spp, 0 * pixels + spp)
            taken.append(time.perf_counter() - start)
        found[variant] = 1e-6 * side * side * spp / min(taken[1:])
    return found


def _table(result: dict[str, Any]) -> str:
    lines = [
        f"# On a GPU: {result['card']}",
        "",
        caption(result),
        "",
        f"Milliseconds, medians of {result['rounds']} calls; megabytes at most.",
        "",
    ]
    for title, rows in (("A map", result["maps"]), ("A loss and its gradient", result["steps"])):
        names = list(dict.fromkeys(name for row in rows for name in row["seconds"]))
        heads = [f"{'x'.join(map(str, row['shape']))}, {row['precision']}" for row in rows]
        lines += [f"## {title}", "", f"| | {' | '.join(heads)} |", "|---" * (len(rows) + 1) + "|"]
        lines += [f"| {name} | {' | '.join(_cell(row, name) for row in rows)} |" for name in names]
        failed = {name: why for row in rows for name, why in row["failed"].items()}
        lines += ["", *(f"{name}: {why}" for name, why in failed.items()), ""]
    lines += [f"{name}: {why}" for name, why in result["missing"].items()]
    apart = ", ".join(f"{name} {found:.1e}" for name, found in result["equal"].items())
    waits = [name for name, found in result["waits"].items() if found]
    renderer = ", ".join(
        f"{variant} {found:.1f} million samples/s" if isinstance(found, float) else found
        for variant, found in result["renderer"].items()
    )
    lines += [
        "",
        f"From the processor's map, as a share, at most {EQUAL:g} wanted: {apart}.",
        f"Maps that wait for the device: {', '.join(waits) or 'none'}.",
        f"Renderer, still life: {renderer}.",
    ]
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any], name: str) -> str:
    if name not in row["seconds"]:
        return "-"
    megabytes = row["peak_megabytes"][name]
    memory = "" if math.isnan(megabytes) else f" ({megabytes:.0f} MB)"
    return f"{1e3 * row['seconds'][name]:.2f}{memory}"


def _plot(result: dict[str, Any], path: Path) -> None:
    figure = blank_figure(7.0, 4.0)
    axis = figure.subplots()
    rows = [row for row in result["maps"] if row["precision"] == "float32"]
    for name in dict.fromkeys(name for row in rows for name in row["seconds"]):
        points = [
            (row["shape"][2] * row["shape"][3] / 1e6, 1e3 * row["seconds"][name])
            for row in rows
            if name in row["seconds"]
        ]
        axis.loglog(*zip(*points, strict=True), marker="o", label=name)
    axis.set_xlabel("megapixels")
    axis.set_ylabel("milliseconds a map")
    axis.set_title(f"float32, {result['card']}", fontsize=10)
    axis.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
