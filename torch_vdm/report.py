"""What a comparison says: its figures, its verdict, its table, its heat map."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from torch import Tensor

from torch_vdm.distance import VISIBLE
from torch_vdm.io import atomic_path

if TYPE_CHECKING:
    from rich.console import RenderableType

# What a heat map's colours are cut at where the largest difference is smaller, in JND, so that
# invisible differences look like nothing. Status: choice.
SMALLEST_SCALE = 2.0


class Figures(TypedDict):
    """The figures of a map, JND."""

    max_jnd: float
    max_pixel: tuple[int, int]
    mean_jnd: float
    p95_jnd: float
    visible_fraction: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The figures of one comparison; the fields of the JSON file.

    JND figures are of the map: its maximum and where it is (x, y), mean and 95th percentile, and
    the share of pixels over 1 JND. ``score_jnd`` takes the image as one stimulus.
    ``mean_luminance_change`` is relative to the reference: -0.1 is 10 % darker; None against a
    black reference. ``seconds`` is the metric's own time.
    """

    max_jnd: float
    max_pixel: tuple[int, int]
    mean_jnd: float
    p95_jnd: float
    visible_fraction: float
    score_jnd: float
    mean_luminance_change: float | None
    width: int
    height: int
    ppd: float
    accuracy: str
    observer: str
    effects: list[str]
    seconds: float
    assumptions: list[str]
    version: str
    reproduce: str

    def verdict(self) -> str:
        """Return one line: whether anybody can see the difference, at this distance."""
        where = f"at {self.ppd:g} pixels per degree"
        if max(self.max_jnd, self.score_jnd) <= VISIBLE:
            return f"Nobody will see a difference {where}: it stays under 1 JND everywhere."
        if self.max_jnd <= VISIBLE:
            return (
                f"Hardly visible {where}: under 1 JND at every single place, but the image as a "
                f"whole may be told apart ({self.score_jnd:.1f} JND)."
            )
        x, y = self.max_pixel
        share = f"{self.visible_fraction:.1%}" if self.visible_fraction >= 5e-4 else "under 0.1%"
        return (
            f"Visible {where}: up to {self.max_jnd:.1f} JND (at x {x}, y {y}), "
            f"in {share} of the image."
        )

    def to_json(self) -> str:
        """Return the figures as JSON, one key a line."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"


def figures(jnd: Tensor) -> Figures:
    """Return the figures of a map (H, W)."""
    values = jnd.flatten().double()
    y, x = divmod(int(values.argmax()), jnd.shape[-1])
    # The smallest value that at least 95 % of the pixels do not exceed; torch.quantile refuses
    # more than 2^24 values.
    rank = max(1, -(-95 * values.numel() // 100))
    return {
        "max_jnd": values.max().item(),
        "max_pixel": (x, y),
        "mean_jnd": values.mean().item(),
        "p95_jnd": values.kthvalue(rank).values.item(),
        "visible_fraction": (values > VISIBLE).double().mean().item(),
    }


def table(comparison: Comparison, luminances: tuple[float, float]) -> "RenderableType":
    """Return the figures as a table for a terminal.

    ``luminances`` are the mean ones of the reference and the test, in cd/m2.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    x, y = comparison.max_pixel
    change = comparison.mean_luminance_change
    changed = "" if change is None else f", {change:+.2%}"
    rows = [
        ("maximum", f"{comparison.max_jnd:.2f} JND", f"at x {x}, y {y}"),
        ("mean", f"{comparison.mean_jnd:.2f} JND", ""),
        ("95th percentile", f"{comparison.p95_jnd:.2f} JND", ""),
        ("visible pixels", f"{comparison.visible_fraction:.1%}", "over 1 JND"),
        ("detection score", f"{comparison.score_jnd:.2f} JND", "the image as one stimulus"),
        (
            "mean luminance",
            f"{luminances[0]:.4g} to {luminances[1]:.4g} cd/m2",
            f"reference to test{changed}",
        ),
    ]
    grid = Table(box=box.SIMPLE_HEAD, show_header=False, pad_edge=False)
    grid.add_column(style="bold", no_wrap=True)
    grid.add_column(justify="right", no_wrap=True)
    grid.add_column(style="dim")
    for row in rows:
        grid.add_row(*(Text(cell) for cell in row))
    return grid


def write_heat_map(path: Path, reference: Tensor, test: Tensor, jnd: Tensor, title: str) -> None:
    """Draw reference, test and map side by side as a PNG, with a colour bar in JND.

    Parameters
    ----------
    path
        The PNG file; it appears whole or not at all.
    reference, test
        (3, H, W), sRGB-coded; values outside [0, 1] are clipped.
    jnd
        (H, W).
    title
        One line over the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = jnd.shape
    # Panels of 4 inches on their longer side; wide images stand above each other.
    rows, columns = (1, 3) if width <= 2 * height else (3, 1)
    scale = 4.0 / max(height, width)
    size = (max(width * scale, 1.0), max(height * scale, 1.0))
    figure = Figure(
        figsize=(columns * size[0] + 1.6, rows * (size[1] + 0.45) + 0.6),
        dpi=150,
        layout="constrained",
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns)
    for axis, image, name in zip(axes, (reference, test), ("reference", "test"), strict=False):
        pixels = image.detach().cpu().clamp(0.0, 1.0).permute(1, 2, 0).numpy()
        axis.imshow(pixels, interpolation="nearest" if max(image.shape) <= 64 else None)
        axis.set_title(name, fontsize=10)
    values = jnd.detach().cpu().float().numpy()
    top = max(SMALLEST_SCALE, float(values.max()))
    shown = axes[2].imshow(values, cmap="inferno", vmin=0.0, vmax=top, interpolation="nearest")
    axes[2].set_title("visible difference", fontsize=10)
    bar = figure.colorbar(shown, ax=axes[2], shrink=0.9 if rows == 1 else 1.0)
    bar.set_label("JND (1 = just noticeable)", fontsize=9)
    bar.ax.axhline(VISIBLE, color="white", linewidth=1.5)
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.suptitle(title, fontsize=10)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)
