"""Losses that move the pixels themselves: 300 steps of Adam from five starts to a picture."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.judges import PPD, psnr
from benchmarks.record import blank_figure
from torch_vdm import VDM

Loss = Callable[[Tensor, Tensor], Tensor]

# Side of the picture: the middle of a render. Status: choice.
SIDE = 64

# Steps of Adam, and its first rate, which falls to 0 by a cosine. Status: choice.
STEPS, RATE = 300, 0.02

# How many pixels the picture is moved to the right for the start "shift". Status: choice.
SHIFT = 8

# Below this, mean JND are drawn on the axis. Status: choice.
LEAST = 1e-3

# Steps between two points of a curve. Status: choice.
EVERY = 10


def starts(reference: Tensor) -> dict[str, Tensor]:
    """Return where to start from, by name; (1, 3, H, W), sRGB-coded, as the reference."""
    generator = torch.Generator().manual_seed(0)
    return {
        "noise": torch.rand(reference.shape, generator=generator),
        "black": torch.zeros_like(reference),
        "white": torch.ones_like(reference),
        "grey": torch.full_like(reference, 0.5),
        "shift": reference.roll(SHIFT, -1),
    }


def curve(
    loss: Loss, start: Tensor, reference: Tensor, steps: int = STEPS, every: int = EVERY
) -> dict[str, list[float]]:
    """Return PSNR (dB, of values clipped to [0, 1]) and mean and largest JND against steps."""
    metric = VDM(PPD)
    image = start.clone().requires_grad_()
    optimizer = torch.optim.Adam([image], lr=RATE)
    figures: dict[str, list[float]] = {"step": [], "PSNR": [], "JND mean": [], "JND max": []}
    for step in range(steps + 1):
        if step % every == 0 or step == steps:
            with torch.no_grad():
                jnd = metric(image, reference)
            figures["step"].append(step)
            figures["PSNR"].append(psnr(image.detach().clamp(0.0, 1.0), reference))
            figures["JND mean"].append(float(jnd.mean()))
            figures["JND max"].append(float(jnd.max()))
        for group in optimizer.param_groups:
            group["lr"] = 0.5 * RATE * (1.0 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        loss(image, reference).backward()
        optimizer.step()
    return figures


def text(curves: dict[str, dict[str, dict[str, list[float]]]]) -> list[str]:
    """Return the table of where the curves end."""
    names = list(next(iter(curves.values())))
    lines = [
        "Each cell: PSNR in dB, mean JND, largest JND at the end.",
        "",
        "| from | " + " | ".join(names) + " |",
        "|---" * (len(names) + 1) + "|",
    ]
    for start, losses in curves.items():
        cells = [
            f"{each['PSNR'][-1]:.0f} / {each['JND mean'][-1]:.2f} / {each['JND max'][-1]:.2f}"
            for each in losses.values()
        ]
        lines.append(f"| {start} | " + " | ".join(cells) + " |")
    return lines


def plot(curves: dict[str, dict[str, dict[str, list[float]]]], path: Path) -> None:
    """Draw the curves: a column for each start, PSNR above, mean JND below."""
    figure = blank_figure(2.3 * len(curves) + 0.6, 5.2)
    axes: Any = figure.subplots(2, len(curves), sharex=True, sharey="row", squeeze=False)
    for (start, losses), (above, below) in zip(curves.items(), axes.T, strict=True):
        for number, (name, figures) in enumerate(losses.items()):
            style = {"color": f"C{number}", "linewidth": 1.4}
            above.plot(figures["step"], figures["PSNR"], label=name, **style)
            below.plot(figures["step"], [max(jnd, LEAST) for jnd in figures["JND mean"]], **style)
        above.set_title(f"from {start}", fontsize=9)
        below.set_yscale("log")
        below.axhline(1.0, color="black", linewidth=0.7, linestyle=":")
        below.set_xlabel("steps of Adam")
        for axis in (above, below):
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("PSNR, dB")
    axes[1, 0].set_ylabel("mean JND")
    axes[1, 0].set_ylim(bottom=LEAST)
    handles = axes[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=9, frameon=False, fontsize=9)
    figure.savefig(path)
