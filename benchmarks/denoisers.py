"""What denoisers leave that is visible: renders of few samples, denoised, beside converged ones.

Intel's Open Image Denoise with and without what guides it, two filters that know nothing of
rendering, and the network of `benchmarks.training` where that has been trained. Judged as a user
would: the pictures are written as EXR, and ``torch-vdm evaluate`` compares them.

The renders are ours: rooms, the still life, and shared scenes where they are there. Pixels are
boxes, so that the noise of one says nothing of its neighbours': what Open Image Denoise was
trained on.
"""

import contextlib
import importlib.metadata
import importlib.util
import io
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks import unet
from benchmarks.judges import PPD, WHITE
from benchmarks.places import CACHE
from benchmarks.record import blank_figure, caption, circumstances, save
from benchmarks.renders import Scene, exposed, exposure, held_out_scenes, rendered
from torch_vdm import read_image, write_image
from torch_vdm.cli import main as torch_vdm_command
from torch_vdm.evaluate.statistics import Paired
from torch_vdm.model.display import decode_srgb, encode_srgb

Floats = NDArray[np.float32]
Denoiser = Callable[[Tensor], Tensor]

# Samples a pixel of the noisy renders. Status: choice.
SAMPLES = (16, 64, 256)

# Samples a pixel of each half of a reference; the halves tell how converged it is. Status: choice,
# what eight scenes can take in a quarter of an hour of one core.
HALF_SPP = 4096

# Seeds of the halves; noisy renders have those from 1 on. Status: choice.
HALVES = (0, 99)

# Sides of the renders in pixels. Status: choice.
SIDE = 128

# Rooms and shared scenes that are denoised. None has a light that a path rarely finds: their
# references would need many times the samples.
ROOMS = range(1000, 1003)
SHARED = ("mis plates", "envmap glass", "textured wall", "cbox")

# Of the bilateral filter: the deviation of its window in pixels, and of its differences in that of
# the noise. Source: Zhang and Gunturk 2008, Multiresolution bilateral filtering for image
# denoising, sec. II. Status: source.
WINDOW, DIFFERENCES = 1.8, 2.0

# Of non-local means: side of a patch and reach of the search in pixels, and the filter's strength
# in the noise's deviation. Source: scikit-image's example "Non-local means denoising for preserving
# textures", its fast variant with a known deviation. Status: source.
PATCH, REACH, STRENGTH = 5, 6, 0.6

# Figures of `torch_vdm.evaluate` that are told: name there, heading, digits.
FIGURES = (
    ("max_jnd", "max, JND", 2),
    ("mean_jnd", "mean, JND", 3),
    ("p95_jnd", "p95, JND", 2),
    ("visible_fraction", "visible share", 3),
    ("psnr", "PSNR, dB", 2),
    ("ssim", "SSIM", 4),
)
MORE_IS_BETTER = ("psnr", "ssim")

STILL = "still life"
NOISY, GUIDED, UNGUIDED = "noisy", "OIDN, albedo and normal", "OIDN, colour"

# The folder of each denoiser: names that a command line takes.
FOLDERS = {
    NOISY: "noisy",
    "bilateral": "bilateral",
    "non-local means": "means",
    UNGUIDED: "oidn",
    GUIDED: "oidn-guided",
    "U-Net": "unet",
}

# The scenes that are shown, where they are, and their samples.
SHOWN, SHOWN_SPP = (STILL, "room 1001", "mis plates"), 16


def run(quick: bool, output: Path | None) -> None:
    """Measure, print the tables, and write denoisers.json, .md and .png to ``output``.

    Renders are kept in `CACHE`, so that a run that was interrupted goes on; a quick run keeps
    nothing.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        _run(work / "renders" if quick else CACHE, work, output, quick)


def scenes(quick: bool) -> list[Scene]:
    """Return what is rendered; shared scenes where they are there."""
    if quick:
        return held_out_scenes(range(0), shared=False)
    found = held_out_scenes(ROOMS)
    own = [scene for scene in found if scene.name.startswith("room") or scene.name == STILL]
    return own + [scene for scene in found if scene.name in SHARED]


def _run(cache: Path, work: Path, output: Path | None, quick: bool) -> None:
    side, half = (48, 64) if quick else (SIDE, HALF_SPP)
    samples = SAMPLES[:2] if quick else SAMPLES
    pictures = []
    for scene in scenes(quick):
        halves = [rendered(scene, cache, side, seed, half) for seed in HALVES]
        mean = (0.5 * (halves[0] + halves[1])).astype(np.float32)
        shots = [
            rendered(scene, cache, side, 1 + number, spp, guides=True)
            for number, spp in enumerate(samples)
        ]
        pictures.append(exposed(scene.name, np.stack(shots), mean))
        for name, image in zip(("one", "other"), halves, strict=True):
            _write(work / "halves" / name, scene.name, torch.from_numpy(image * exposure(mean)))
        _write(work / "reference", scene.name, pictures[-1].reference)
    found, missing = denoisers(cache)
    seconds: dict[str, list[float]] = {name: [] for name in found}
    for number, spp in enumerate(samples):
        for name, denoiser in found.items():
            for each in pictures:
                begin = time.perf_counter()
                clean = denoiser(each.noisy[number])
                seconds[name].append(time.perf_counter() - begin)
                _write(work / str(spp) / FOLDERS[name], each.name, clean)
    result: dict[str, Any] = {
        **circumstances(),
        "peers": _versions(),
        "missing": missing,
        "settings": {
            "side": side,
            "samples": list(samples),
            "reference_spp": 2 * half,
            "ppd": PPD,
            "white": WHITE,
        },
        "scenes": [each.name for each in pictures],
        "reference_error": _own_error(work),
        "seconds": {name: statistics.median(taken) for name, taken in seconds.items()},
        "samples": {},
    }
    for spp in samples:
        told = judged(
            work / "reference", {FOLDERS[name]: work / str(spp) / FOLDERS[name] for name in found}
        )
        result["samples"][str(spp)] = {
            "figures": {
                name: {
                    frame["frame"]: frame["figures"]
                    for frame in told["frames"]
                    if frame["test"] == FOLDERS[name]
                }
                for name in found
            },
            "comparisons": told["comparisons"],
        }
    text = _text(result)
    print(text)
    if output is not None:
        save(output, "denoisers", result, text)
        shown_spp = SHOWN_SPP if SHOWN_SPP in samples else samples[0]
        _plot(result, work, shown_spp, list(found), output / "denoisers.png")


def denoisers(cache: Path) -> tuple[dict[str, Denoiser], dict[str, str]]:
    """Return the denoisers, from (10, H, W) as in `Picture` to light (3, H, W), and what lacks."""
    found: dict[str, Denoiser] = {NOISY: lambda shot: shot[:3]}
    missing = {}
    if importlib.util.find_spec("skimage"):
        found["bilateral"] = lambda shot: _filtered(shot, _bilateral)
        found["non-local means"] = lambda shot: _filtered(shot, _non_local_means)
    else:
        missing["bilateral, non-local means"] = "scikit-image is not installed"
    if importlib.util.find_spec("pyoidn"):
        found[UNGUIDED] = lambda shot: open_image_denoise(shot, guided=False)
        found[GUIDED] = lambda shot: open_image_denoise(shot, guided=True)
    else:
        missing["Open Image Denoise"] = "pyoidn is not installed; pip install 'torch-vdm[denoise]'"
    trained = sorted(cache.glob("VDMLoss_0_*.pt"), key=lambda path: path.stat().st_mtime)
    if trained:
        network = unet.UNet()
        network.load_state_dict(torch.load(trained[-1], weights_only=True))
        network.eval()
        found["U-Net"] = lambda shot: unet.denoise(network, shot[None])[0]
    else:
        missing["U-Net"] = "it is not trained on this machine; python -m benchmarks training"
    return found, missing


def open_image_denoise(shot: Tensor, guided: bool) -> Tensor:
    """Return the light (3, H, W) that Open Image Denoise makes of a render (10, H, W).

    Light is linear and may exceed white; albedo and normal are as noisy as the render's.
    """
    import pyoidn

    colour, albedo, normal = (
        np.ascontiguousarray(shot[first : first + 3].permute(1, 2, 0).numpy(), np.float32)
        for first in (0, 3, 6)
    )
    guides = {"albedo": albedo.clip(0.0, 1.0), "normal": normal} if guided else {}
    clean = pyoidn.denoise(colour.clip(0.0), hdr=True, quality="high", **guides)
    return torch.from_numpy(np.asarray(clean)).permute(2, 0, 1)


def _filtered(shot: Tensor, denoise: Callable[[Floats, float], Floats]) -> Tensor:
    """Return the light that a filter of values makes of a render.

    Filters see what `benchmarks.unet` does: differences about as large as they look, and lamps that
    are not thousands. They are told the noise's deviation as scikit-image estimates it.
    """
    from skimage.restoration import estimate_sigma

    values = torch.log1p(encode_srgb(shot[:3].clamp_min(0.0))).permute(1, 2, 0).numpy()
    deviation = float(estimate_sigma(values, channel_axis=-1, average_sigmas=True))
    clean = torch.from_numpy(denoise(values, deviation)).permute(2, 0, 1).float()
    return decode_srgb(torch.expm1(clean)).clamp_min(0.0)


def _bilateral(values: Floats, deviation: float) -> Floats:
    from skimage.restoration import denoise_bilateral

    clean: Floats = denoise_bilateral(
        values,
        sigma_color=DIFFERENCES * deviation,
        sigma_spatial=WINDOW,
        mode="edge",
        channel_axis=-1,
    )
    return clean


def _non_local_means(values: Floats, deviation: float) -> Floats:
    from skimage.restoration import denoise_nl_means

    clean: Floats = denoise_nl_means(
        values,
        patch_size=PATCH,
        patch_distance=REACH,
        h=STRENGTH * deviation,
        sigma=deviation,
        fast_mode=True,
        channel_axis=-1,
    )
    return clean


def judged(reference: Path, tests: Mapping[str, Path]) -> dict[str, Any]:
    """Return what ``torch-vdm evaluate`` writes of folders of images as results.json.

    Raises
    ------
    RuntimeError
        If it cannot compare them.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = ["evaluate", f"--reference={reference}", f"--output={folder}/out"]
        command += [f"--test={name}={place}" for name, place in tests.items()]
        command += [f"--ppd={PPD:g}", f"--white={WHITE:g}"]
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            status = torch_vdm_command(command)
        if status:
            raise RuntimeError(f"torch-vdm {' '.join(command)}: {said.getvalue()}")
        told: dict[str, Any] = json.loads((Path(folder) / "out/results.json").read_text())
        return told


def _own_error(work: Path) -> dict[str, dict[str, float]]:
    """Return the error of each reference by scene, in JND: its difference to each of its halves.

    What a half differs from the mean of both by, half the difference of the halves, is independent
    of the mean's own error and has the same deviation: it looks like it. The larger of the two.
    """
    halves = {name: work / "halves" / name for name in ("one", "other")}
    errors: dict[str, dict[str, float]] = {}
    for frame in judged(work / "reference", halves)["frames"]:
        known = errors.setdefault(frame["frame"], {})
        for name in ("max_jnd", "p95_jnd", "mean_jnd"):
            known[name] = max(known.get(name, 0.0), frame["figures"][name])
    return errors


def mean(scenes: Mapping[str, Mapping[str, float]], figure: str) -> float | None:
    """Return the mean of a figure over scenes, None where one lacks it."""
    values = [each.get(figure) for each in scenes.values()]
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known and len(known) == len(values) else None


def _write(folder: Path, name: str, light: Tensor) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    write_image(folder / f"{name}.exr", light.float().contiguous())


def _versions() -> dict[str, str]:
    found = {}
    for package in ("mitsuba", "pyoidn", "scikit-image"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def _text(result: dict[str, Any]) -> str:
    settings, samples = result["settings"], result["samples"]
    peers = ", ".join(f"{name} {version}" for name, version in result["peers"].items())
    errors = result["reference_error"].values()
    largest = max(each["max_jnd"] for each in errors)
    most = max(each["p95_jnd"] for each in errors)
    usual = statistics.median(each["max_jnd"] for each in errors)
    side = settings["side"]
    lines = [
        "# What denoisers leave that is visible",
        "",
        f"{caption(result)}; {peers}",
        "",
        f"{len(result['scenes'])} scenes of {side}x{side} pixels ({', '.join(result['scenes'])}), "
        f"seen at {settings['ppd']:g} pixels per degree, white {settings['white']:g} cd/m2. "
        f"References have {settings['reference_spp']} samples a pixel; their own error, their "
        f"difference to a half of their samples, is at most {largest:.2f} JND, in the median scene "
        f"{usual:.2f}, and {most:.2f} JND for 95 % of the pixels "
        "of the worst one. Means over the scenes, by `torch-vdm evaluate`:",
        "",
    ]
    for spp, told in samples.items():
        lines += [f"## {spp} samples a pixel", ""]
        lines.append("| | " + " | ".join(heading for _, heading, _ in FIGURES) + " |")
        lines.append("|---" * (len(FIGURES) + 1) + "|")
        columns = {
            figure: {name: mean(each, figure) for name, each in told["figures"].items()}
            for figure, _, _ in FIGURES
        }
        for name in told["figures"]:
            cells = [
                _cell(columns[figure], name, digits, figure in MORE_IS_BETTER)
                for figure, _, digits in FIGURES
            ]
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
        lines += ["", *_sentences(told["comparisons"]), ""]
    first = next(iter(samples.values()))["figures"]
    lines += ["## Largest difference by scene, JND", ""]
    lines.append("| scene | samples | " + " | ".join(first) + " |")
    lines.append("|---" * (len(first) + 2) + "|")
    for scene in result["scenes"]:
        for spp, told in samples.items():
            cells = [f"{each[scene]['max_jnd']:.2f}" for each in told["figures"].values()]
            lines.append(f"| {scene} | {spp} | " + " | ".join(cells) + " |")
    taken = ", ".join(f"{name} {value:.2f}" for name, value in result["seconds"].items())
    lines += ["", f"Seconds for a picture, median, one thread for torch: {taken}.", ""]
    lines += [f"{name} is left out: {why}." for name, why in result["missing"].items()]
    return "\n".join(lines).rstrip() + "\n"


def _sentences(comparisons: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return what `torch-vdm evaluate` says of each denoiser beside the noisy picture."""
    noisy = FOLDERS[NOISY]
    pairs = [each for each in comparisons if each["figure"] == "max_jnd" and each["one"] == noisy]
    return [f"- {Paired(**each).sentence('Maximum')}" for each in pairs]


def _cell(column: Mapping[str, float | None], name: str, digits: int, more: bool) -> str:
    """Return a figure of a denoiser, bold where it is the best one."""
    value = column[name]
    if value is None:
        return ""
    known = [each for each in column.values() if each is not None]
    best = max(known) if more else min(known)
    return f"**{value:.{digits}f}**" if value == best else f"{value:.{digits}f}"


def _plot(
    result: Mapping[str, Any], work: Path, spp: int, names: Sequence[str], path: Path
) -> None:
    """Draw scenes by each denoiser with their maps, and figures against samples beneath."""
    from torch_vdm import VDM, Display, StationaryHaar

    metric = VDM(PPD, Display.linear(WHITE), transform=StationaryHaar(csf="filter"))
    shown = [scene for scene in SHOWN if scene in result["scenes"]]
    figure = blank_figure(2.2 * (len(names) + 1), 4.6 * len(shown) + 3.6)
    parts: Any = figure.subfigures(2, 1, height_ratios=(4.6 * len(shown), 3.6))
    above, beneath = parts
    axes: Any = above.subplots(2 * len(shown), len(names) + 1)
    for axis in axes.flat:
        axis.set_axis_off()
    drawn: Any = None
    for row, scene in enumerate(shown):
        reference = read_image(work / "reference" / f"{scene}.exr")[None]
        pictures, maps = axes[2 * row], axes[2 * row + 1]
        for picture, below, name in zip(pictures, maps, names, strict=False):
            image = read_image(work / str(spp) / FOLDERS[name] / f"{scene}.exr")[None]
            with torch.no_grad():
                jnd = metric(image, reference)[0, 0].numpy()
            picture.imshow(_screen(image), interpolation="nearest")
            picture.set_title(f"{spp} samples" if name == NOISY else name, fontsize=9)
            drawn = below.imshow(jnd, cmap="inferno", vmin=0.0, vmax=4.0, interpolation="nearest")
            told = result["samples"][str(spp)]["figures"][name][scene]
            below.set_title(
                f"max {told['max_jnd']:.1f} JND, {told['visible_fraction']:.0%} visible", fontsize=8
            )
        pictures[-1].imshow(_screen(reference), interpolation="nearest")
        pictures[-1].set_title("reference", fontsize=9)
        bar = maps[-1].inset_axes((0.02, 0.05, 0.07, 0.9))
        above.colorbar(drawn, cax=bar, label="JND", extend="max")
    curves: Any = beneath.subplots(1, 3)
    drawn_figures = [each for each in FIGURES if each[0] in ("max_jnd", "visible_fraction", "psnr")]
    for axis, (name_of, heading, _) in zip(curves, drawn_figures, strict=True):
        for name in names:
            values = [mean(told["figures"][name], name_of) for told in result["samples"].values()]
            axis.plot([int(each) for each in result["samples"]], values, "o-", label=name)
        axis.set_xscale("log", base=2)
        axis.set_xticks([int(each) for each in result["samples"]], list(result["samples"]))
        axis.set_xlabel("samples a pixel")
        axis.set_title(f"{heading}, mean of {len(result['scenes'])} scenes", fontsize=9)
        axis.grid(alpha=0.3)
        if name_of != "psnr":
            axis.set_ylim(bottom=0.0)
    curves[0].axhline(1.0, color="black", linewidth=0.8, linestyle=":")
    curves[-1].legend(fontsize=8)
    figure.savefig(path)


def _screen(light: Tensor) -> Any:
    return encode_srgb(light)[0].clamp(0.0, 1.0).permute(1, 2, 0).numpy()
