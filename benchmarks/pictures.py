"""What each transform's map says of pictures, beside what `reference` says.

No people's thresholds are behind these pairs. They are what the metric is used for: noise of
renders, what denoisers and codecs leave, colour casts, shifts. An image that one rung passes
another should not fail.
"""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from benchmarks import record
from benchmarks.places import shared_data
from benchmarks.rungs import ALL
from torch_vdm import VDM, Display, Observer, read_image
from torch_vdm.model.cortex import Transform
from torch_vdm.model.display import decode_srgb, encode_srgb

Array = NDArray[np.float64]

# The side of a picture in pixels, and its first row and column in a photograph.
SIDE, CORNER = 256, 100

# Contrast of white noise and of a grating, sRGB-coded; the deviation of noise that rises with the
# light, as a renderer's does; that of what is left by a denoiser, in patches of so many pixels; how
# many grey levels bands have; how much more red and less blue a cast is. Status: choice, for 0.5 to
# 5 JND.
NOISE, WAVE, GRAIN, RESIDUE, PATCH, BANDS, CAST = 0.02, 0.02, 0.15, 0.015, 8, 40.0, 0.03

# How many photographs are judged. Status: choice.
PHOTOGRAPHS = 5

# Beside what the others are held; the pixels per degree of all pictures.
JUDGE, PPD = "reference", 60.0


class Pair(NamedTuple):
    """A distorted picture and what it was made of, sRGB-coded (1, 3, H, W), 0 to 1."""

    kind: str
    test: Tensor
    reference: Tensor


def distorted(photo: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Return what a picture (1, 3, H, W), sRGB-coded, is like after each distortion."""
    height, width = photo.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    noise = torch.randn(photo.shape, generator=generator, dtype=photo.dtype)
    box = torch.full((3, 1, 3, 3), 1.0 / 9.0, dtype=photo.dtype)
    blurred = functional.conv2d(functional.pad(photo, (1,) * 4, "replicate"), box, groups=3)
    normal = torch.randn(photo[:, :1].shape, generator=generator, dtype=photo.dtype)
    size = -(-height // PATCH), -(-width // PATCH)
    patches = torch.randn(1, 3, *size, generator=generator, dtype=photo.dtype)
    residue = functional.interpolate(patches, scale_factor=PATCH, mode="bilinear")
    cast = torch.tensor([1.0 + CAST, 1.0, 1.0 - CAST]).view(1, 3, 1, 1)
    sparse = functional.interpolate(photo[..., ::2, ::2], scale_factor=2.0, mode="nearest")
    tests = {
        "noise": photo + NOISE * noise,
        "grain": grainy(photo, normal),
        "residue": photo + RESIDUE * residue[..., :height, :width],
        "blur": blurred,
        "half of blur": 0.5 * (photo + blurred),
        "JPEG": jpeg(photo, 40),
        "JPEG, good": jpeg(photo, 85),
        "bands": (photo * BANDS).round() / BANDS,
        "aliases": sparse[..., :height, :width],
        "cast": photo * cast,
        "shift": photo.roll(1, -1),
        "grating": photo + WAVE * torch.sin(2.0 * math.pi * (x / 8.0 + y / 19.0)),
    }
    return {kind: test.to(photo.dtype).clamp(0.0, 1.0) for kind, test in tests.items()}


def grainy(photo: Tensor, normal: Tensor) -> Tensor:
    """Return a picture with noise that rises with its light, from normal numbers."""
    return encode_srgb(decode_srgb(photo) * (1.0 + GRAIN * normal))


def jpeg(photo: Tensor, quality: int) -> Tensor:
    """Return a picture (1, 3, H, W) as a JPEG file has it."""
    from PIL import Image

    file = io.BytesIO()
    whole = (photo[0] * 255.0).round().to(torch.uint8).permute(1, 2, 0).numpy()
    Image.fromarray(whole).save(file, "JPEG", quality=quality)
    read = np.asarray(Image.open(file), dtype=np.float32) / 255.0
    return torch.from_numpy(read).permute(2, 0, 1)[None]


def photographs(count: int) -> dict[str, Tensor]:
    """Return pictures (1, 3, SIDE, SIDE), sRGB-coded, by name; none without the shared ones."""
    here = slice(CORNER, CORNER + SIDE)
    paths = sorted((shared_data() / "ldr").glob("*.png"))[:count]
    return {path.stem: read_image(path)[None, :, here, here].contiguous() for path in paths}


def renders() -> Iterator[Pair]:
    """Yield renders of few samples beside those of many."""
    for folder in sorted((shared_data() / "mc_pairs").glob("*/")):
        paths = {path.stem: path for path in folder.glob("*.exr")}
        reference = next(path for name, path in paths.items() if name.startswith("ref_5"))
        converged = _coded(reference)
        for name, path in sorted(paths.items()):
            if name.startswith("noisy"):
                yield Pair(f"{int(name[6:9])} samples", _coded(path), converged)


def _coded(path: Path) -> Tensor:
    return encode_srgb(read_image(path)[None].clamp(0.0, 1.0))


def of_photographs(count: int) -> Iterator[list[Pair]]:
    """Yield all distortions of a photograph, photograph by photograph."""
    generator = torch.Generator().manual_seed(1)
    for photo in photographs(count).values():
        tests = distorted(photo, generator)
        yield [Pair(kind, test, photo) for kind, test in tests.items()]


def pairs(quick: bool) -> Iterator[Pair]:
    """Yield everything that is judged."""
    for some in of_photographs(1 if quick else PHOTOGRAPHS):
        yield from some
    if not quick:
        yield from renders()


def largest(observer: Observer | None, transform: Transform, some: list[Pair]) -> Array:
    """Return the largest value of every pair's map, JND."""
    metric = VDM(PPD, Display.srgb(), observer, transform)
    with torch.no_grad():
        return np.array([metric.score(pair.test, pair.reference).item() for pair in some])


def run(quick: bool, output: Path | None) -> None:
    if not photographs(1):
        print(f"skipped: there is no {shared_data() / 'ldr'}; TORCH_VDM_DATA names the folder")
        return
    rungs = {n: t for n, t in ALL.items() if not quick or n in ("fast", JUDGE)}
    metrics = {name: VDM(PPD, Display.srgb(), transform=t) for name, t in rungs.items()}
    rows: list[dict[str, Any]] = []
    with torch.no_grad():
        for kind, test, reference in pairs(quick):
            maps = {name: metric(test, reference) for name, metric in metrics.items()}
            figures = {n: [jnd.max().item(), jnd.mean().item()] for n, jnd in maps.items()}
            rows.append({"kind": kind, "max_and_mean_jnd": figures})
    result = {**record.circumstances(), "rows": rows}
    text = table(result)
    print(text)
    if output is not None:
        record.save(output, "pictures", result, text)


def table(result: dict[str, Any]) -> str:
    rows = result["rows"]
    names = list(rows[0]["max_and_mean_jnd"])
    others = [name for name in names if name != JUDGE]
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    lines = [
        "# What each transform says of pictures",
        "",
        record.caption(result),
        "",
        f"The largest value of the map and its mean over those of `{JUDGE}`: geometric means over "
        "the pictures of a kind and, after ±, the standard deviation, in octaves.",
        "",
        f"| | {JUDGE}, JND | " + " | ".join(f"{n}: largest | {n}: mean" for n in others) + " |",
        "|---|---|" + "---|---|" * len(others),
    ]
    for kind in (*kinds, None):
        some = [row["max_and_mean_jnd"] for row in rows if kind in (None, row["kind"])]
        largest = 2.0 ** float(np.mean([math.log2(row[JUDGE][0]) for row in some]))
        cells = [f"{largest:.1f}"]
        for name in others:
            for figure in (0, 1):
                octaves = [math.log2(row[name][figure] / row[JUDGE][figure]) for row in some]
                cells.append(f"{2.0 ** np.mean(octaves):.2f} ± {np.std(octaves):.2f}")
        lines.append(f"| {kind or 'all'} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
