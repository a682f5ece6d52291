"""Memory and answers of `VDM.tiled` on images larger than memory.

Each size runs in a process of its own, from two .npy files of sRGB noise, 8 bits, to a map in a
memory-mapped file. Memory is the process's largest resident set: torch, the pages of the map that
the system has not written out yet, everything.
"""

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.record import blank_figure, caption, circumstances, measured_apart, save
from benchmarks.speed import status
from torch_vdm import VDM
from torch_vdm.cli import TRANSFORMS
from torch_vdm.io import ArrayFile

THREADS = 2
SIZES = ((2048, 2048), (4096, 4096), (8192, 8192), (16384, 16384))
QUICK_SIZES = ((300, 420),)

# Up to so many pixels the whole image is computed as well, and the two maps are compared.
LARGEST_WHOLE = 2**24


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the table, and write large.json, large.md and large.png to ``output``."""
    sizes = QUICK_SIZES if quick else SIZES
    tile = 128 if quick else 1024
    runs = [("fast", size) for size in sizes]
    runs += [] if quick else [(name, sizes[0]) for name in ("standard", "reference")]
    result: dict[str, Any] = {**circumstances(), "tile": tile, "runs": []}
    result["machine"]["threads"] = THREADS
    for accuracy, size in runs:
        row = _child(accuracy, size, tile)
        print(json.dumps(row), file=sys.stderr)
        result["runs"].append(row)
    table = _table(result)
    print(table)
    if output is not None:
        save(output, "large", result, table)
        _plot(result, output / "large.png")


def _child(accuracy: str, size: tuple[int, int], tile: int) -> dict[str, Any]:
    """Measure one size in processes of their own: tiles, and where it is small the difference."""
    height, width = size
    row: dict[str, Any] = {"accuracy": accuracy, "height": height, "width": width}
    with tempfile.TemporaryDirectory() as folder:
        _write_pair(Path(folder), size)
        for what in ("tiles", "difference") if height * width <= LARGEST_WHOLE else ("tiles",):
            row |= measured_apart("large", what, folder, accuracy, tile)
    return row


def _write_pair(folder: Path, size: tuple[int, int]) -> None:
    """Write two images (H, W, 3) that differ everywhere, a band of rows at a time."""
    rng = np.random.default_rng(1)
    files = [
        np.lib.format.open_memmap(
            folder / f"{name}.npy", mode="w+", dtype=np.uint8, shape=(*size, 3)
        )
        for name in ("reference", "test")
    ]
    for top in range(0, size[0], 256):
        shape = files[0][top : top + 256].shape
        reference = rng.integers(8, 248, shape, dtype=np.uint8)
        files[0][top : top + 256] = reference
        files[1][top : top + 256] = reference + rng.integers(-3, 4, shape, dtype=np.int8)


def _measure(what: str, folder: Path, accuracy: str, tile: int) -> dict[str, float]:
    """Return peak memory and times, or the largest difference between tiles and the whole."""
    torch.set_num_threads(THREADS)
    test, reference = (ArrayFile(folder / f"{name}.npy") for name in ("test", "reference"))
    height, width = test.shape[1:]
    metric = VDM(transform=TRANSFORMS[accuracy]())
    jnd = torch.from_file(str(folder / "map"), shared=True, size=height * width)
    jnd = jnd.view(1, height, width)
    start, cpu = time.perf_counter(), time.process_time()
    metric.tiled(test, reference, tile, jnd)
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu
    if what == "tiles":
        # Not getrusage's: a process inherits that of the one that began it.
        return {"peak_bytes": 1e3 * status("VmHWM"), "seconds": seconds, "cpu_seconds": cpu_seconds}
    scale = np.float32(255.0)
    images = (torch.from_numpy(image[:, :, :] / scale).unsqueeze(0) for image in (test, reference))
    with torch.no_grad():
        whole = metric(*images)[0]
    return {"max_jnd": whole.max().item(), "difference": (whole - jnd).abs().max().item()}


def _table(result: dict[str, Any]) -> str:
    lines = [
        "# Images larger than memory",
        "",
        caption(result),
        "",
        f"`VDM.tiled` with tiles of {result['tile']}: sRGB noise of 8 bits and its copy with an "
        "error of up to 3 codes, from two .npy files to a memory-mapped map. Memory is the "
        "process's largest resident set, torch and the map included.",
        "",
        "| | pixels | peak, GiB | CPU seconds | largest JND | largest difference from the whole |",
        "|---|---|---|---|---|---|",
    ]
    for row in result["runs"]:
        whole = ("—", "—")
        if "difference" in row:
            whole = f"{row['max_jnd']:.2f}", f"{row['difference']:.1e}"
        lines.append(
            f"| {row['accuracy']} | {row['width']} x {row['height']} | "
            f"{row['peak_bytes'] / 2**30:.2f} | {row['cpu_seconds']:.0f} | "
            f"{whole[0]} | {whole[1]} |"
        )
    return "\n".join(lines) + "\n"


def _plot(result: dict[str, Any], path: Path) -> None:
    figure = blank_figure(6.0, 3.6)
    axis = figure.subplots()
    rows = [row for row in result["runs"] if row["accuracy"] == "fast"]
    areas = [row["width"] * row["height"] / 1e6 for row in rows]
    axis.plot(areas, [row["peak_bytes"] / 2**30 for row in rows], marker="o", label="VDM.tiled")
    axis.plot(areas, [4e6 * area / 2**30 for area in areas], "--", label="the map alone, float32")
    axis.set_xscale("log")
    axis.set_ylim(bottom=0.0)
    axis.set_xlabel("megapixels")
    axis.set_ylabel("peak memory of the process, GiB")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False)
    figure.savefig(path)


if __name__ == "__main__":
    print(json.dumps(_measure(sys.argv[1], Path(sys.argv[2]), sys.argv[3], int(sys.argv[4]))))
