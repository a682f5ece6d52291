"""Human contrast thresholds, and the stimuli that they were measured with."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torch_vdm.model.cones import XYZ_TO_SML

TABLE = Path(__file__).parent / "data" / "contrast_thresholds.csv"

# CIE XYZ of D65 at 1 cd/m2, the background of every stimulus. Status: choice; the table's own
# backgrounds are given in other cone fundamentals than Eq. 1's.
D65 = (0.95047, 1.0, 1.08883)

# How far a stimulus lies off the centre of its image, in cycles: no observer places it on a grid.
# Status: choice.
OFF_CENTRE = 0.31

# A Gabor patch is drawn to this many standard deviations. Status: choice.
EXTENT = 3.5

# The frequency for which a disc is drawn, times the root of its area: its edge and its area need
# more pixels than half a cycle does. Status: choice; three times as many move thresholds by 1 dB.
DISC_SCALE = 2.0

# No stimulus is drawn larger: pixels. What a glance takes in of a larger one is drawn whole.
LARGEST_SIDE = 512


@dataclass(frozen=True)
class Threshold:
    """One row of the table.

    Attributes
    ----------
    row
        Its number, from 0.
    frequency
        Cycles/degree; of a disc 0.
    area
        Degrees squared.
    sigma
        Standard deviation of the Gaussian envelope in degrees; None: a sharp aperture.
    luminance
        Of the background, cd/m2.
    contrast
        Cone contrast at threshold, S, M, L.
    stimulus
        "gabor", "grating" or "disk".
    orientation
        Of the grating in degrees: 0 is vertical bars.
    """

    row: int
    study: str
    condition: str
    mechanism: str
    frequency: float
    area: float
    sigma: float | None
    luminance: float
    contrast: tuple[float, float, float]
    stimulus: str
    orientation: float

    @property
    def scale(self) -> float:
        """Return the frequency that decides how finely the stimulus is drawn, cycles/degree."""
        return self.frequency or DISC_SCALE / math.sqrt(self.area)


def read_thresholds(path: Path = TABLE) -> list[Threshold]:
    """Return all rows of the table."""
    with path.open(newline="") as file:
        return [
            Threshold(
                row=number,
                study=row["study"],
                condition=row["condition"],
                mechanism=row["mechanism"],
                frequency=float(row["spatial_frequency_cpd"]),
                area=float(row["area_deg2"]),
                sigma=float(row["gauss_sigma_deg"]) if row["gauss_sigma_deg"] else None,
                luminance=float(row["luminance_cdm2"]),
                contrast=(float(row["cS"]), float(row["cM"]), float(row["cL"])),
                stimulus=row["stimulus"],
                orientation=float(row["orientation_deg"]),
            )
            for number, row in enumerate(csv.DictReader(file))
        ]


def sampling(threshold: Threshold, cycle: float) -> float:
    """Return the pixels per degree at which a cycle has ``cycle`` / 2 to ``cycle`` pixels.

    An octave apart for all frequencies of an octave, so that few different ones are needed.
    """
    return float(cycle * 2.0 ** math.floor(math.log2(threshold.scale)))


def pattern(threshold: Threshold, ppd: float, phase: float) -> Tensor:
    """Return the stimulus (H, W), float64, at a contrast of 1, ``phase`` in radians.

    Its centre lies `OFF_CENTRE` off that of the image.
    """
    half = math.sqrt(threshold.area) / 2.0
    if threshold.stimulus == "disk":
        half = math.sqrt(threshold.area / math.pi)
    elif threshold.sigma is not None:
        half = EXTENT * threshold.sigma
    span = (2.0 * half + 2.0 / threshold.scale) * ppd
    side = min(2 ** math.ceil(math.log2(max(64.0, span))), LARGEST_SIDE)
    x = (torch.arange(side, dtype=torch.float64) - side / 2) / ppd - OFF_CENTRE / threshold.scale
    y = x.unsqueeze(1)
    if threshold.stimulus == "disk":
        disc: Tensor = x * x + y * y < half * half
        return disc.double()
    if threshold.sigma is not None:
        envelope = torch.exp(-(x * x + y * y) / (2.0 * threshold.sigma**2))
    else:
        envelope = ((x.abs() <= half) & (y.abs() <= half)).double()
    across = x if threshold.orientation == 0.0 else y
    drawn: Tensor = envelope * torch.cos(2.0 * math.pi * threshold.frequency * across + phase)
    return drawn


def background(luminance: float) -> Tensor:
    """Return S, M, L (3,) of D65 at ``luminance`` cd/m2."""
    return luminance * (torch.tensor(XYZ_TO_SML).double() @ torch.tensor(D65).double())


def render(threshold: Threshold, drawn: Tensor, times: float) -> Tensor:
    """Return CIE XYZ (1, 3, H, W), cd/m2, of the stimulus at ``times`` its threshold contrast."""
    contrast = times * torch.tensor(threshold.contrast).double()
    light = background(threshold.luminance).view(3, 1, 1) * (1.0 + contrast.view(3, 1, 1) * drawn)
    to_xyz = torch.linalg.inv(torch.tensor(XYZ_TO_SML).double())
    return torch.einsum("ij,jhw->ihw", to_xyz, light).unsqueeze(0)
