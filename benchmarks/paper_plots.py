"""The pictures of `benchmarks.paper`: Figs. 9 to 13, and the curves of real scenes."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.curves import charged
from benchmarks.record import blank_figure

if TYPE_CHECKING:
    from benchmarks.paper import Found

Plane = NDArray[np.float64]

COLOURS = {"uniform": "C7", "objective": "C1", "halfbuffer": "C2", "perceptual": "C0"}
NAMES = {"halfbuffer": "half-buffer"}

# Samples over their mean, in powers of 2, and the largest visible difference in JND, that the maps
# show. Status: choice.
DENSITIES = 3.0


def draw(output: Path, found: Sequence["Found"], strategies: Sequence[str]) -> None:
    """Write a picture of each scene's images at equal samples, and of all curves."""
    for one in found:
        if all(run.planes for runs in one.runs.values() for run in runs.values()):
            name = one.scene.name.replace(", ", "_").replace(" ", "_")
            _images(output / f"paper_{name}.png", one, strategies)
    own = [one for one in found if not one.real]
    real = [one for one in found if one.real]
    if own:
        _curves(output / "paper.png", own, strategies)
    if real:
        _curves(output / "paper_real.png", real, strategies)


def refinement(path: Path, steps: Sequence[tuple[float, Plane, Plane, float]]) -> None:
    """Draw the image and where its samples lie after each round (Fig. 9)."""
    figure, axes = _figure(2, len(steps) + 1, 1.5 * len(steps) + 1.2, 3.5)
    for i, (spp, image, count, true) in enumerate(steps):
        _show(axes[0][i], image)
        axes[0][i].set_title(f"{spp:.0f} a pixel\n{true:.1f} JND", fontsize=8)
        shown = _density(axes[1][i], count)
    axes[0][0].set_ylabel("image", fontsize=8)
    axes[1][0].set_ylabel("samples", fontsize=8)
    axes[0][-1].axis("off")
    axes[1][-1].axis("off")
    _bar(figure, shown, axes[1][-1], "log2 of samples\nover their mean")
    figure.savefig(path)


def _images(path: Path, one: "Found", strategies: Sequence[str]) -> None:
    """Draw sample density, image and visible difference of every strategy (Figs. 10, 11)."""
    seed = min(one.runs[strategies[0]])
    planes = {name: one.runs[name][seed].planes for name in strategies}
    largest = max(float(p["jnd"].max()) for p in planes.values())
    figure, axes = _figure(3, len(strategies) + 1, 8.6, 5.2)
    for i, name in enumerate(strategies):
        axes[0][i].set_title(NAMES.get(name, name), fontsize=9)
        density = _density(axes[0][i], planes[name]["count"])
        _show(axes[1][i], planes[name]["image"])
        jnd = axes[2][i].imshow(planes[name]["jnd"], "magma", vmin=0.0, vmax=largest)
        axes[2][i].set_xlabel(f"at most {planes[name]['jnd'].max():.2f} JND", fontsize=8)
    for axis, label in zip(
        (row[0] for row in axes), ("samples", "image", "difference"), strict=True
    ):
        axis.set_ylabel(label, fontsize=8)
    _show(axes[1][-1], one.reference.image)
    axes[1][-1].set_title("reference", fontsize=9)
    axes[0][-1].axis("off")
    axes[2][-1].axis("off")
    _bar(figure, density, axes[0][-1], "log2 of samples\nover their mean")
    _bar(figure, jnd, axes[2][-1], "JND")
    figure.suptitle(f"{one.scene.name}: {one.scene.equal_spp} samples a pixel", fontsize=10)
    figure.savefig(path)


def _curves(path: Path, found: Sequence["Found"], strategies: Sequence[str]) -> None:
    """Draw the largest difference by samples and by time, each seed a line (Figs. 12, 13)."""
    figure = blank_figure(9.0, 2.0 * len(found) + 0.5, dpi=130)
    axes = figure.subplots(
        len(found), 3, squeeze=False, gridspec_kw={"width_ratios": (0.62, 1.0, 1.0)}
    )
    for (picture, samples, seconds), one in zip(axes, found, strict=True):
        _show(picture, one.reference.image)
        picture.set_title(one.scene.name, fontsize=9)
        for axis, of in ((samples, "spp"), (seconds, "seconds")):
            for name in strategies:
                for i, run in enumerate(one.runs[name].values()):
                    points = charged(name, run.points)
                    axis.plot(
                        [point[of] for point in points],
                        [point["true"] for point in points],
                        color=COLOURS[name],
                        linewidth=1.0,
                        label=NAMES.get(name, name) if i == 0 else None,
                    )
            for tolerance in one.scene.tolerances:
                axis.axhline(tolerance, color="black", linewidth=0.6, linestyle=":")
            axis.set_xscale("log")
            axis.set_yscale("log")
            axis.set_yticks([1.0, 2.0, 5.0, 10.0], labels=["1", "2", "5", "10"], fontsize=7)
            axis.minorticks_off()
            axis.tick_params(labelsize=7)
            axis.spines[["top", "right"]].set_visible(False)
        samples.set_ylabel("largest difference, JND", fontsize=8)
    axes[-1][1].set_xlabel("samples a pixel", fontsize=8)
    axes[-1][2].set_xlabel("seconds of processor time", fontsize=8)
    axes[0][2].legend(frameon=False, fontsize=7)
    figure.savefig(path)


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Any, Any]:
    figure = blank_figure(width, height, dpi=130)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    return figure, axes


def _show(axis: Any, image: Plane) -> None:
    """Draw linear BT.709 as sRGB."""
    clipped = np.clip(image, 0.0, 1.0)
    coded = np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1.0 / 2.4) - 0.055)
    axis.imshow(coded, interpolation="nearest")
    axis.set_xticks([])
    axis.set_yticks([])


def _density(axis: Any, count: Plane) -> Any:
    """Draw how the samples lie: blue fewer than the mean, red more."""
    shown = np.log2(count / count.mean())
    return axis.imshow(shown, "RdBu_r", vmin=-DENSITIES, vmax=DENSITIES)


def _bar(figure: Any, shown: Any, axis: Any, label: str) -> None:
    """Draw a scale at the left of an empty place."""
    bar = figure.colorbar(shown, cax=axis.inset_axes((0.05, 0.05, 0.1, 0.9)))
    bar.set_label(label, fontsize=7)
    bar.ax.tick_params(labelsize=7)
