"""Noisy renders, what guides a denoiser, and their references: rendered once, kept on disk.

Trained on are random rooms alone, so that anyone can repeat it. Held out are other rooms, the
still life that comes with `vdm-render`, and, where `TORCH_VDM_DATA` or ``../shared/data`` has
them, scenes made by hand whose light, materials and cameras no room has: fog, a caustic, bump
maps, bitmaps, an environment. No scene is in both.
"""

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.rooms import room
from benchmarks.scenes import SIDES, STILL_LIFE, scene_file
from sampling.renderers.mitsuba import AOV_NAMES, MitsubaRenderer
from torch_vdm.io import atomic_path

# Samples a pixel of the noisy render, and of its reference. Status: choice.
NOISY_SPP, REFERENCE_SPP = 64, 1024

# Noisy renders of a scene that are trained on, with other random numbers. Status: choice.
TAKES = 2

# Sides of the renders in pixels. Status: choice.
SIDE = 128

# Seeds of the rooms that are trained on, and of those held out. Status: choice.
TRAINING_ROOMS, HELD_OUT_ROOMS = range(24), range(1000, 1004)

# The grey that a picture is exposed for: its geometric mean luminance over white. Status: choice.
GREY = 0.18

# Luminance of linear BT.709. Source: IEC 61966-2-1:1999. Status: source.
LUMINANCE = (0.2126, 0.7152, 0.0722)

# Channels of what a denoiser is given: colour, albedo, normal, depth.
CHANNELS = 3 + len(AOV_NAMES)


class Scene(NamedTuple):
    """A scene to render: a file, or the XML of a random room."""

    name: str
    source: Path | str
    size: tuple[str, ...] = SIDES[STILL_LIFE]


class Picture(NamedTuple):
    """A scene as a denoiser meets it, exposed so that its geometric mean is `GREY`."""

    name: str
    noisy: Tensor
    """(K, 10, H, W): colour (linear BT.709, over white), albedo, normal (of the world, -1 to 1) and
    depth (d / (d + mean), 0 to 1), each of K takes."""
    reference: Tensor
    """(3, H, W), linear BT.709 over white."""


def training_scenes(rooms: range = TRAINING_ROOMS) -> list[Scene]:
    """Return the rooms that are trained on."""
    return [Scene(f"room {seed}", room(seed)) for seed in rooms]


def held_out_scenes(rooms: range = HELD_OUT_ROOMS, shared: bool = True) -> list[Scene]:
    """Return the scenes that are judged, and never trained on."""
    scenes = [Scene(f"room {seed}", room(seed)) for seed in rooms]
    for name, size in SIDES.items():
        if scene_file(name).is_file() and (shared or name == STILL_LIFE):
            word = name.removesuffix(".xml").removesuffix("/scene").replace("_", " ")
            scenes.append(Scene(word, scene_file(name), size))
    return scenes


def picture(
    scene: Scene,
    cache: Path,
    side: int = SIDE,
    takes: int = 1,
    noisy_spp: int = NOISY_SPP,
    reference_spp: int = REFERENCE_SPP,
) -> Picture:
    """Render a scene, or read it from ``cache``.

    The reference is of other random numbers than every take.
    """
    noisy = [rendered(scene, cache, side, 1 + take, noisy_spp, True) for take in range(takes)]
    reference = rendered(scene, cache, side, 0, reference_spp)
    return exposed(scene.name, np.stack(noisy), reference)


def rendered(
    scene: Scene, cache: Path, side: int, seed: int, spp: int, guides: bool = False
) -> NDArray[np.float32]:
    """Return a render of ``spp`` samples a pixel, or read it from ``cache``.

    (3, H, W), linear BT.709 in the scene's own units; (10, H, W) with ``guides``, of which the
    depth is in the scene's units too. Other seeds are of other random numbers.
    """
    cache.mkdir(parents=True, exist_ok=True)
    if isinstance(scene.source, str):
        path = cache / f"{scene.name.replace(' ', '_')}.xml"
        with atomic_path(path) as temporary:
            temporary.write_text(scene.source)
    else:
        path = scene.source
    renderer = MitsubaRenderer(path, dict.fromkeys(scene.size, str(side)), seed=seed, aov=guides)
    what = f"{renderer.fingerprint} {renderer.version} {seed} {spp} {guides}"
    kept = cache / f"{path.stem}_{hashlib.sha256(what.encode()).hexdigest()[:16]}.npy"
    if not kept.exists():
        colour = _colour(renderer, spp)
        planes = np.concatenate((colour, [*renderer.aovs().values()])) if guides else colour
        with atomic_path(kept) as temporary, temporary.open("wb") as file:
            np.save(file, planes.astype(np.float32))
    stored: NDArray[np.float32] = np.load(kept)
    return stored


def _colour(renderer: MitsubaRenderer, spp: int) -> NDArray[np.float64]:
    """Return the mean of ``spp`` samples a pixel, (3, H, W); what is not finite counts as black."""
    height, width = renderer.size
    pixels = np.arange(height * width)
    total = np.zeros((height * width, 3))
    # In rounds, for all samples of a reference do not fit in memory.
    for begin in range(0, spp, 64):
        count = np.full(len(pixels), min(64, spp - begin))
        drawn = renderer.sample(pixels, np.full(len(pixels), begin), count)
        light = np.nan_to_num(drawn.radiance, nan=0.0, posinf=0.0, neginf=0.0)
        for channel in range(3):
            total[:, channel] += np.bincount(drawn.pixels, light[:, channel], len(pixels))
    return (total.T / spp).reshape(3, height, width)


def exposed(name: str, noisy: NDArray[np.float32], reference: NDArray[np.float32]) -> Picture:
    """Expose a picture by its reference, and bring depth into 0 to 1."""
    scale = exposure(reference)
    shots = torch.from_numpy(noisy.copy())
    shots[:, :3] *= scale
    depth = shots[:, -1:]
    shots[:, -1:] = depth / (depth + depth.mean().clamp_min(1e-6))
    return Picture(name, shots, torch.from_numpy(reference * np.float32(scale)))


def exposure(reference: NDArray[np.float32]) -> float:
    """Return what brings the geometric mean luminance of a picture (3, H, W) to `GREY`."""
    luminance = np.tensordot(LUMINANCE, reference.astype(np.float64), 1)
    # The floor keeps a black background from setting the exposure.
    return float(GREY / np.exp(np.log(luminance + 1e-2 * luminance.mean()).mean()))
