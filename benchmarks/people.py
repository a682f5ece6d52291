"""What people saw, beyond contrast thresholds of gratings, and what the metric says of it."""

import csv
import json
import math
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks import record
from benchmarks.places import shared_data
from benchmarks.rungs import RUNGS
from benchmarks.thresholds import D65
from torch_vdm import VDM, Display, Observer, read_image
from torch_vdm.model.cortex import Transform

Array = NDArray[np.float64]

# Pixels per degree of SIN3D's screen. Not documented: two pictures of 800 pixels side by side on a
# desk's screen are about 35 to 50; the first is what is fitted. Status: choice.
PPD, PPDS = 45.0, (30.0, 45.0, 60.0)

# Luminance of its white, cd/m2; not documented. Status: choice.
WHITE = 200.0

# Sides of a zone in pixels, zones in a row, and the view that has its scene here.
ZONE, ACROSS, VIEW = 200, 4, "p3d_staircase2-view0"

# What a triangle filter of radius 1 leaves of the noise of a pixel in it and in the next, along
# rows and columns: of overlapping triangles. Status: derived, from their correlation.
TRIANGLE = (0.789, 0.211)


# Foley's Gabor patch: cycles/degree, standard deviation in degrees, cd/m2, and the pixels per
# degree and side in pixels at which it is drawn. The envelope is not in the file: choice.
PATCH_FREQUENCY, PATCH_SIGMA, PATCH_LUMINANCE, PATCH_PPD, SIDE = 2.0, 0.5, 32.0, 32.0, 128

# The Gabor patch on noise: cycles/degree, standard deviation, cd/m2, and where the noise ends, in
# cycles/degree. The second and the last are not in the file: choice.
NOISY_FREQUENCY, NOISY_SIGMA, NOISY_LUMINANCE, NOISE_END = 1.2, 0.5, 37.0, 12.0

# JND levels of the wavelet thresholds, and the pixels per degree of their screen.
LEVELS = (1, 2, 3, 4, 5, 6)
PITCH, DISTANCE = 0.1845, 600.0

# Levels of the wavelet transform that those thresholds were measured with; the side of a picture.
OCTAVES, PICTURE = 5, 256

DECIBELS = 20.0 / math.log(10.0)


class Zone(NamedTuple):
    """A zone of a rendered picture at the samples at which people could not tell it any more."""

    noisy: Tensor
    """(1, 3, ZONE, ZONE), linear, 0 to 1."""
    converged: Tensor


@lru_cache
def zones(seed: int = 0) -> list[Zone]:
    """Return SIN3D's zones of the view whose scene is there, row by row; none without the data.

    S. Delepoulle et al.; normal noise with the variance of that scene's samples over their number.
    """
    folder = shared_data() / "people"
    if not (folder / "sin3d_thresholds.csv").exists():
        return []
    with (folder / "sin3d_thresholds.csv").open(newline="") as file:
        samples = next(
            row[1:] for row in csv.reader(file, delimiter=";") if row[0].startswith(VIEW)
        )
    path = folder / "staircase2_stats.exr"
    mean, deviation = read_image(path), _deviation(str(path))
    generator = torch.Generator().manual_seed(seed)
    found = []
    for number in range(ACROSS * ACROSS):
        top, left = (ZONE * place for place in divmod(number, ACROSS))
        here = slice(top, top + ZONE), slice(left, left + ZONE)
        # One number for all three channels, as a path's light has one brightness.
        noise = torch.randn(1, ZONE + 1, ZONE + 1, generator=generator, dtype=torch.float32)
        noise = TRIANGLE[0] * noise[:, :-1] + TRIANGLE[1] * noise[:, 1:]
        noise = TRIANGLE[0] * noise[..., :-1] + TRIANGLE[1] * noise[..., 1:]
        light = mean[:, *here]
        noisy = light + noise * deviation[:, *here] / math.sqrt(float(samples[number]))
        found.append(Zone(noisy.clamp(0.0, 1.0)[None], light.clamp(0.0, 1.0)[None]))
    return found


def _deviation(path: str) -> Tensor:
    """Return the standard deviation of one sample, (3, H, W)."""
    import OpenEXR

    with OpenEXR.File(path, separate_channels=True) as file:
        planes = [file.channels()[f"sd.{name}"].pixels for name in "RGB"]
        return torch.from_numpy(np.stack(planes).astype(np.float32))


def zone_scores(
    observer: Observer | None, transform: Transform, ppd: float, some: list[Zone]
) -> Array:
    """Return the largest value of every zone's map, JND."""
    metric = VDM(ppd, Display.linear(WHITE), observer, transform)
    with torch.no_grad():
        return np.array([metric.score(zone.noisy, zone.converged).item() for zone in some])


def gabor(frequency: float, sigma: float, orientation: float = 0.0, phase: float = 0.4) -> Tensor:
    """Return a Gabor patch (SIDE, SIDE) of contrast 1 at `PATCH_PPD`, in no node's middle."""
    x = (torch.arange(SIDE) - 0.47 * SIDE) / PATCH_PPD
    y = x.unsqueeze(1)
    turn = math.radians(orientation)
    along = math.cos(turn) * x + math.sin(turn) * y
    envelope = torch.exp(-(x * x + y * y) / (2.0 * sigma * sigma))
    drawn: Tensor = envelope * torch.cos(2.0 * math.pi * frequency * along + phase)
    return drawn


def white_noise(end: float) -> Tensor:
    """Return noise (SIDE, SIDE) of rms contrast 1, white up to ``end`` cycles/degree."""
    generator = torch.Generator().manual_seed(1)
    spectrum = torch.fft.fft2(torch.randn(SIDE, SIDE, generator=generator))
    cycles = torch.fft.fftfreq(SIDE, 1.0 / PATCH_PPD)
    spectrum[torch.hypot(cycles, cycles.unsqueeze(1)) > end] = 0.0
    noise: Tensor = torch.fft.ifft2(spectrum).real
    return noise / noise.std()


def threshold_on(metric: VDM, luminance: float, mask: Tensor, target: Tensor) -> float:
    """Return the contrast in dB at which a target on a mask scores 1, by bisection."""

    def light(contrast: Tensor) -> Tensor:
        grey = luminance * (1.0 + contrast).clamp_min(0.0)
        return grey * torch.tensor(D65).view(1, 3, 1, 1)

    low, high = -60.0, 0.0
    for _ in range(10):
        middle = 0.5 * (low + high)
        stimulus = light(mask + 10.0 ** (middle / 20.0) * target)
        seen = metric.score(stimulus, light(mask)).item() > 1.0
        low, high = (low, middle) if seen else (middle, high)
    return 0.5 * (low + high)


def masked_by_gratings(transform: Transform) -> list[dict[str, float]]:
    """Return Foley's thresholds, and those of the metric, dB re contrast 1."""
    metric = VDM(PATCH_PPD, Display.xyz(), transform=transform)
    target = gabor(PATCH_FREQUENCY, PATCH_SIGMA)
    found = []
    with (shared_data() / "people" / "foley1994_masking.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            turn, mask = float(row["orientation"]), row["c_mask"].strip()
            # The first row has the threshold without a mask.
            contrast = 10.0 ** (float(mask) / 20.0) if mask not in ("", "0", "-inf") else 0.0
            drawn = contrast * gabor(PATCH_FREQUENCY, PATCH_SIGMA, turn)
            predicted = threshold_on(metric, PATCH_LUMINANCE, drawn, target)
            found.append(
                {
                    "orientation": turn,
                    "mask_db": float(mask) if contrast else -60.0,
                    "human_db": float(row["c_target"]),
                    "metric_db": predicted,
                }
            )
    return found


def masked_by_noise(transform: Transform) -> list[dict[str, float]]:
    """Return the thresholds of a Gabor patch on noise, people's and the metric's, dB."""
    metric = VDM(PATCH_PPD, Display.xyz(), transform=transform)
    target, noise = gabor(NOISY_FREQUENCY, NOISY_SIGMA), white_noise(NOISE_END)
    table = json.loads((shared_data() / "people" / "gabor_on_noise.json").read_text())
    pairs = zip(table["mask_contrast_list"], table["test_contrast_list"], strict=True)
    return [
        {
            "mask_db": DECIBELS * math.log(mask),
            "human_db": DECIBELS * math.log(human),
            "metric_db": threshold_on(metric, NOISY_LUMINANCE, mask * noise, target),
        }
        for mask, human in pairs
    ]


def quantised(transform: Transform) -> list[dict[str, Any]]:
    """Return what the metric says of quantisation errors of the JND levels, subband by subband.

    Errors of the luminance: uniform in a subband of CDF 9/7 wavelets, as far as the threshold goes.
    """
    import pywt

    degree = 2.0 * DISTANCE * math.tan(math.radians(0.5)) / PITCH
    metric = VDM(degree, Display.srgb(), transform=transform)
    rng = np.random.default_rng(1)
    with warnings.catch_warnings():
        # Of borders at the coarsest level, which periodic ones do not have.
        warnings.simplefilter("ignore", UserWarning)
        zero = pywt.wavedec2(np.zeros((PICTURE, PICTURE)), "bior4.4", "periodization", OCTAVES)
    rows: dict[str, dict[int, float]] = {}
    for level in LEVELS:
        path = shared_data() / "people" / "wavelet_vt" / f"monitorA_VT{level}.txt"
        for line in path.read_text().splitlines()[1:]:
            _, colour, band, threshold, *_ = line.split()
            if colour == "1" and not band.startswith("LL"):
                rows.setdefault(band, {})[level] = float(threshold)
    flat = torch.full((1, 3, PICTURE, PICTURE), 0.5)
    found = []
    for band, thresholds in rows.items():
        octave, kind = int(band[2]), ("LH", "HL", "HH").index(band[:2])
        size = zero[OCTAVES + 1 - octave][kind].shape
        error = rng.uniform(-1.0, 1.0, size)
        coefficients = [zero[0], *(list(level) for level in zero[1:])]
        # Of a synthesis of gain 1 at 0 cycles, where pywt's has sqrt(2) a level and side.
        coefficients[OCTAVES + 1 - octave][kind] = error * 2.0**octave
        drawn = torch.from_numpy(pywt.waverec2(coefficients, "bior4.4", "periodization")).float()
        scores = [metric.score(flat + t * drawn, flat).item() for t in thresholds.values()]
        found.append({"band": band, "levels": list(thresholds), "jnd": scores})
    return found


def run(quick: bool, output: Path | None) -> None:
    if not zones():
        print(f"skipped: there is no {shared_data() / 'people'}; TORCH_VDM_DATA names the folder")
        return
    result: dict[str, Any] = {**record.circumstances(), "rungs": {}}
    with torch.no_grad():
        for name, transform in list(RUNGS.items())[: 1 if quick else None]:
            result["rungs"][name] = {
                "zones": {
                    str(ppd): zone_scores(None, transform, ppd, zones()).tolist() for ppd in PPDS
                },
                "foley": masked_by_gratings(transform),
                "noise": masked_by_noise(transform),
                "quantisation": quantised(transform),
            }
    text = table(result)
    print(text)
    if output is not None:
        record.save(output, "people", result, text)
        plot(result, output / "people.png")


def summary(found: dict[str, Any]) -> dict[str, float]:
    """Return one number a source: what the table has."""
    numbers = {}
    for ppd, scores in found["zones"].items():
        octaves = np.log2(scores)
        numbers[f"zones {float(ppd):.0f}"] = 2.0 ** float(octaves.mean())
        numbers[f"spread {float(ppd):.0f}"] = float(octaves.std())
    for key in ("foley", "noise"):
        rows = found[key]
        turns = sorted({row.get("orientation", 0.0) for row in rows})
        for turn in turns:
            some = [row for row in rows if row.get("orientation", 0.0) == turn]
            miss = np.array([row["metric_db"] - row["human_db"] for row in some])
            name = f"{key} {turn:.0f}" if key == "foley" else key
            numbers[f"{name} mean"] = float(miss.mean())
            numbers[f"{name} rms"] = float(miss.std())
    levels = np.log(np.array(LEVELS))
    seen = np.array([np.log(row["jnd"]) for row in found["quantisation"]])
    numbers["quantisation at level 1"] = float(np.exp(seen[:, 0].mean()))
    numbers["quantisation slope"] = float(
        np.polyfit(np.tile(levels, len(seen)), seen.ravel(), 1)[0]
    )
    return numbers


TITLES = {
    "zones 30": "SIN3D's zones at people's thresholds, 30 pixels/degree: geometric mean, JND",
    "zones 45": "45 pixels/degree, JND",
    "zones 60": "60 pixels/degree, JND",
    "spread 45": "spread over the zones at 45, octaves",
    "foley 0 mean": "Gabor patch on a grating of its own direction: metric over people, dB",
    "foley 0 rms": "the same, scatter after one gain, dB",
    "foley 45 mean": "on one at 45 degrees, dB",
    "foley 45 rms": "the same, scatter, dB",
    "foley 90 mean": "on one at 90 degrees, dB",
    "foley 90 rms": "the same, scatter, dB",
    "noise mean": "Gabor patch on noise: metric over people, dB",
    "noise rms": "the same, scatter, dB",
    "quantisation at level 1": "quantisation error of wavelets at the first JND level: JND",
    "quantisation slope": "the same, slope of log JND over log of the level, 1 to 6",
}


def table(result: dict[str, Any]) -> str:
    numbers = {name: summary(found) for name, found in result["rungs"].items()}
    lines = [
        "# What people saw beside gratings",
        "",
        record.caption(result),
        "",
        "| | " + " | ".join(numbers) + " |",
        "|---|" + "---|" * len(numbers),
    ]
    for key, title in TITLES.items():
        lines.append(f"| {title} | " + " | ".join(f"{n[key]:.2f}" for n in numbers.values()) + " |")
    return "\n".join(lines) + "\n"


def plot(result: dict[str, Any], path: Path) -> None:
    figure = record.blank_figure(11.0, 7.5)
    zone_axis, grating_axis, noise_axis, level_axis = figure.subplots(2, 2).flat
    for number, (name, found) in enumerate(result["rungs"].items()):
        colour = f"C{number}"
        for ppd, marker in zip(PPDS, ("v", "o", "^"), strict=True):
            scores = found["zones"][str(ppd)]
            label = f"{ppd:.0f} pixels/degree" if number == 0 else None
            places = np.arange(len(scores)) + 0.2 * (number - 1)
            zone_axis.plot(places, scores, marker, color=colour, markersize=4, label=label)
        for turn, style in ((0.0, "-"), (45.0, "--"), (90.0, ":")):
            rows = [row for row in found["foley"] if row["orientation"] == turn]
            rows = sorted(
                (row for row in rows if row["mask_db"] > -60.0), key=lambda r: r["mask_db"]
            )
            at = [row["mask_db"] for row in rows]
            grating_axis.plot(at, [row["metric_db"] for row in rows], style, color=colour)
            if number == 0:
                human = [row["human_db"] for row in rows]
                label = f"people, mask at {turn:.0f} degrees"
                grating_axis.plot(at, human, style, color="black", marker="o", label=label)
        at = [row["mask_db"] for row in found["noise"]]
        noise_axis.plot(at, [row["metric_db"] for row in found["noise"]], color=colour, label=name)
        if number == 0:
            human = [row["human_db"] for row in found["noise"]]
            noise_axis.plot(at, human, "o-", color="black", label="people")
        seen = np.exp(np.mean([np.log(row["jnd"]) for row in found["quantisation"]], 0))
        level_axis.plot(LEVELS, seen / seen[0], "o-", color=colour, label=name)
    zone_axis.axhline(1.0, color="black", linewidth=0.8)
    zone_axis.set_yscale("log")
    zone_axis.minorticks_off()
    zone_axis.set(
        title="Noise that people just do not see (SIN3D)",
        xlabel="zone",
        ylabel="JND by the metric",
        yticks=[0.5, 1.0, 2.0, 3.0],
        yticklabels=["0.5", "1", "2", "3"],
    )
    grating_axis.set(
        title="A Gabor patch on a grating (Foley 1994)",
        xlabel="contrast of the mask, dB",
        ylabel="contrast at threshold, dB",
    )
    noise_axis.set(
        title="A Gabor patch on noise",
        xlabel="rms contrast of the noise, dB",
        ylabel="contrast at threshold, dB",
    )
    level_axis.plot(LEVELS, LEVELS, color="black", label="stated")
    level_axis.set(
        title="Quantisation error of wavelets: JND levels",
        xlabel="JND level stated",
        ylabel="JND by the metric, level 1 = 1",
    )
    for axis in (zone_axis, grating_axis, noise_axis, level_axis):
        axis.legend(fontsize=7, frameon=False)
    figure.savefig(path)
