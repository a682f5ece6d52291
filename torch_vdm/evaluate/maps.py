"""What the page shows of a map: a histogram of its pixels, and where the worst places are."""

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.report import BAND

# Borders between the bars of a histogram, in JND: three per octave from 1/16 to 128, 1 JND among
# them. Status: choice.
BORDERS = tuple(2.0 ** (step / 3.0) for step in range(-12, 22))

# How many regions are reported, and the side of one, in degrees of vision and at least in pixels:
# what the eye sees sharply at once. Status: choice.
REGIONS, REGION_DEGREES, SMALLEST_REGION = 8, 1.0, 16

Region = tuple[int, int, int, int, float]


def counts(jnd: Tensor) -> list[int]:
    """Return how many pixels of a map (H, W) lie between the borders, below and above them.

    A value on a border belongs below it: what is over 1 JND is visible.
    """
    borders = torch.tensor(BORDERS, dtype=jnd.dtype)
    found = torch.zeros(len(BORDERS) + 1, dtype=torch.int64)
    for band in jnd.split(max(1, BAND // jnd.shape[-1])):
        places = torch.bucketize(band.flatten(), borders)
        found += places.bincount(minlength=len(found))
    return [int(count) for count in found]


def regions(jnd: Tensor, ppd: float) -> list[Region]:
    """Return the worst places of a map (H, W): x, y, width, height, and the largest JND in each.

    Squares of about one degree of vision around the largest differences, the worst first; none has
    its largest difference within another.
    """
    height, width = jnd.shape
    side = max(SMALLEST_REGION, round(REGION_DEGREES * ppd))
    rest = -height % side, -width % side
    padded = functional.pad(jnd[None, None], (0, rest[1], 0, rest[0]), value=-1.0)
    peaks, places = functional.max_pool2d(padded, side, return_indices=True)
    order = peaks.flatten().argsort(descending=True, stable=True)
    chosen: list[tuple[int, int, float]] = []
    for number in order.tolist():
        peak = peaks.flatten()[number].item()
        if peak <= 0.0 or len(chosen) == REGIONS:
            break
        y, x = divmod(int(places.flatten()[number]), width + rest[1])
        if all(max(abs(x - a), abs(y - b)) > side // 2 for a, b, _ in chosen):
            chosen.append((x, y, peak))
    return [(*_square(x, y, side, width, height), peak) for x, y, peak in chosen]


def _square(x: int, y: int, side: int, width: int, height: int) -> tuple[int, int, int, int]:
    """Return x, y, width and height of a square around a pixel, moved into the image."""
    across, down = min(side, width), min(side, height)
    left = min(max(0, x - across // 2), width - across)
    top = min(max(0, y - down // 2), height - down)
    return left, top, across, down
