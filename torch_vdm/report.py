"""What a comparison says: its figures, its verdict, its table, its heat map."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO, TypedDict

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.io import atomic_path
from torch_vdm.model.distance import VISIBLE
from torch_vdm.run.tiling import Source, read

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

# The least upper end of a heat map's colour scale, in JND, so that invisible differences look like
# nothing. Status: choice.
SMALLEST_SCALE = 2.0

# Pixels of a map that are processed at once, and the largest side of a panel in a heat map, in
# pixels: more would not be seen. Status: choice.
BAND = 2**22
LARGEST_PANEL = 1200

# Images with a larger aspect ratio, wide or tall, are stretched: a line shows nothing.
# Status: choice.
LONGEST = 16


class Figures(TypedDict):
    """The figures of a map, in JND."""

    max_jnd: float
    max_pixel: tuple[int, int]
    mean_jnd: float
    p95_jnd: float
    visible_fraction: float


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The figures of one comparison; the fields of the JSON file.

    JND figures are those of the map: its maximum and where it is (x, y), mean and 95th percentile,
    and the share of pixels over 1 JND. ``score_jnd`` is that of `VDM.score`, the maximum again.
    ``mean_luminance_change`` is relative to the reference: -0.1 is 10 % darker; None against a
    black reference. ``left_out``: what was not computed, and why it changes no figure.
    ``seconds`` is the metric's own time.
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
    left_out: list[str]
    seconds: float
    assumptions: list[str]
    version: str
    reproduce: str

    def verdict(self) -> str:
        """Return one line: whether anybody can see the difference, at this distance."""
        where = f"at {self.ppd:g} pixels per degree"
        if self.max_jnd <= VISIBLE:
            return f"Nobody will see a difference {where}: it stays under 1 JND everywhere."
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
    """Return the figures of a map (H, W), float32, in bands: it may be larger than memory."""
    width = jnd.shape[-1]
    bands = jnd.split(max(1, BAND // width))
    largest, place, total, visible, top = -1.0, 0, 0.0, 0, 0
    for band in bands:
        here = band.max().item()
        if here > largest:
            largest, place = here, top * width + int(band.argmax())
        total += band.double().sum().item()
        visible += int((band > VISIBLE).sum())
        top += len(band)
    y, x = divmod(place, width)
    return {
        "max_jnd": largest,
        "max_pixel": (x, y),
        "mean_jnd": total / jnd.numel(),
        # The smallest value that at least 95 % of the pixels do not exceed.
        "p95_jnd": _ranked(bands, max(1, -(-95 * jnd.numel() // 100))),
        "visible_fraction": visible / jnd.numel(),
    }


def _ranked(bands: Sequence[Tensor], rank: int) -> float:
    """Return the value of a rank, counted from 1, among values of 0 or more in float32.

    Such numbers are ordered like their bits: the upper half of these is found first, then the
    lower.
    """
    chosen, half = 0, 2**16
    for step in range(2):
        counts = torch.zeros(half, dtype=torch.int64)
        for band in bands:
            bits = band.float().contiguous().view(torch.int32).flatten()
            some = bits // half if step == 0 else bits[bits // half == chosen] % half
            counts += some.bincount(minlength=half).cpu()
        reached = counts.cumsum(0)
        place = int(torch.searchsorted(reached, rank))
        rank -= int(reached[place] - counts[place])
        chosen = chosen * half + place
    return torch.tensor(chosen, dtype=torch.int32).view(torch.float32).item()


def shrunk(source: Source) -> Tensor:
    """Return an image (3, H, W) reduced to fit a panel: means of blocks of pixels."""
    height, width = source.shape[-2:]
    block = -(-height // LARGEST_PANEL), -(-width // LARGEST_PANEL)
    rows = block[0] * max(1, BAND // (block[0] * width))
    parts = [
        functional.avg_pool2d(
            read(source, 0, (slice(top, min(top + rows, height)), slice(0, width))).float(),
            block,
            ceil_mode=True,
            count_include_pad=False,
        )
        for top in range(0, height, rows)
    ]
    return torch.cat(parts, -2)[0]


def _shrunk_map(jnd: Tensor) -> Tensor:
    """Return a map (H, W) reduced to fit a panel: maxima of blocks of pixels."""
    height, width = jnd.shape
    block = -(-height // LARGEST_PANEL), -(-width // LARGEST_PANEL)
    bands = jnd.split(block[0] * max(1, BAND // (block[0] * width)))
    parts = [
        functional.max_pool2d(band[None, None].float(), block, ceil_mode=True) for band in bands
    ]
    return torch.cat(parts, -2)[0, 0]


def plain_console(text: TextIO, width: int) -> "Console":
    """Return a console that writes to ``text`` as for a terminal at least ``width`` wide.

    The text is plain: nothing in a path is markup, and no number is coloured. A terminal that is
    too narrow wraps lines; a table cut to its width would lose figures.
    """
    from rich.console import Console

    terminal = Console()
    return Console(
        file=text,
        force_terminal=terminal.is_terminal,
        width=max(terminal.width, width),
        highlight=False,
        markup=False,
        soft_wrap=True,
    )


@contextmanager
def progress(what: str, count: int) -> Iterator[Callable[[], None]]:
    """Show a bar with the time left on a terminal; yield a function that moves it on by one."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

    console = Console(stderr=True)
    bar = Progress(
        what,
        BarColumn(),
        MofNCompleteColumn(),
        "left:",
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task("", total=count)
        yield lambda: bar.advance(task)


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
        (3, h, w), sRGB-coded, as `shrunk` gives them; values outside [0, 1] are clipped.
    jnd
        (H, W), of any size.
    title
        One line above the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    jnd = _shrunk_map(jnd.detach())
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
        if max(height, width) > LONGEST * min(height, width):
            axis.set_aspect("auto")
    figure.suptitle(title, fontsize=10)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)
