"""The metric as a `torchmetrics.Metric`, for training loops and Lightning.

torchmetrics is not among the package's requirements: ``pip install torchmetrics``.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, Self, get_args
from zlib import crc32

import torch
from torch import Tensor

from torch_vdm.model.display import Display
from torch_vdm.model.distance import VISIBLE
from torch_vdm.pair import PairMetric
from torch_vdm.precision import widest
from torch_vdm.vdm import VDM

try:
    from torchmetrics import Metric
except ImportError as error:
    raise ImportError(
        "torch_vdm.metrics needs torchmetrics, which is not installed: pip install torchmetrics"
    ) from error

Figure = Literal["mean_jnd", "max_jnd", "visible_fraction"]

FIGURES = get_args(Figure)


class VisualDifference(Metric):
    """Visible differences over a data set.

    `compute` returns a dictionary of 0-dim tensors: ``mean_jnd`` over all pixels, ``max_jnd``, and
    ``visible_fraction``, the share of pixels over 1 JND; or one of them, as Lightning's
    ``self.log("jnd", metric)`` takes it. The states are a sum and a maximum in float64 (float32
    if a device has nothing wider) and counts, and stay so through `half()` and the like: batches,
    devices and processes add up to what one pass would give, and no image is kept.

    Parameters
    ----------
    ppd, display
        As in `VDM`.
    vdm_options
        Further options of `VDM`, by name.
    figure
        The figure to compute, as a tensor; None: all three.
    metric
        A metric to use instead, such as `VDM.paper()`; then ``ppd``, ``display`` and
        ``vdm_options`` are left out.
    options
        Those of `torchmetrics.Metric`.

    Raises
    ------
    ValueError
        If a parameter or an image is not as stated.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    plot_lower_bound = 0.0

    pixels: Tensor
    jnd: Tensor
    visible: Tensor
    largest: Tensor

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        vdm_options: dict[str, Any] | None = None,
        figure: Figure | None = None,
        metric: PairMetric | None = None,
        **options: Any,
    ) -> None:
        if figure not in (None, *FIGURES):
            raise ValueError(f"expected a figure of {', '.join(FIGURES)}, got {figure!r}")
        if not isinstance(vdm_options, dict | None):
            raise ValueError(f"expected vdm_options: a dictionary or None, got {vdm_options!r}")
        if not isinstance(metric, PairMetric | None):
            raise ValueError(f"expected a metric such as VDM(), got {metric!r}")
        if metric is not None and (ppd, display, vdm_options) != (60.0, None, None):
            raise ValueError("expected a metric or options for one, got both; give them to VDM()")
        super().__init__(**options)
        self.figure = figure
        self.vdm = VDM(ppd, display, **(vdm_options or {})) if metric is None else metric
        zero = torch.zeros((), dtype=widest(torch.get_default_device()))
        self.add_state("jnd", zero.clone(), dist_reduce_fx="sum")
        self.add_state("largest", zero.clone(), dist_reduce_fx="max")
        for name in ("pixels", "visible"):
            self.add_state(name, torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")
        # A collection merges metrics with equal states: those with other options never have them.
        self.add_state("options", _bits(self.vdm), dist_reduce_fx="max")

    @property
    def plot_upper_bound(self) -> float | None:  # type: ignore[override]  # an attribute there
        """The largest value of a plot."""
        return 1.0 if self.figure == "visible_fraction" else None

    @torch.no_grad()
    def update(self, preds: Tensor, target: Tensor) -> None:
        """Add a batch, (B, 3, H, W) and (B, 3, H, W); sizes may differ between batches."""
        jnd = self.vdm(preds, target).to(self.jnd.dtype)
        self.pixels += jnd.numel()
        self.jnd += jnd.sum()
        self.visible += (jnd > VISIBLE).sum()
        self.largest = torch.maximum(self.largest, jnd.max())

    def compute(self) -> dict[str, Tensor] | Tensor:
        """Return mean_jnd, max_jnd and visible_fraction of everything added, or one of them."""
        pixels, visible = self.pixels.to(self.jnd), self.visible.to(self.jnd)
        figures = (self.jnd / pixels, self.largest, visible / pixels)
        found = dict(zip(FIGURES, figures, strict=True))
        return found if self.figure is None else found[self.figure]

    def plot(self, val: Any = None, ax: Any = None) -> Any:
        """Plot values of `compute`, by default the current one; as `torchmetrics.Metric.plot`."""
        return self._plot(val, ax)

    def _apply(self, fn: Callable[[Tensor], Tensor], exclude_state: Sequence[str] = "") -> Self:
        """Move the states with the module, but never to a lower precision."""
        self._computed = self._forward_cache = None
        super()._apply(fn, (*exclude_state, *self._defaults))

        def moved(state: Tensor) -> Tensor:
            dtype = widest(self.device) if state.is_floating_point() else state.dtype
            return state.to(self.device, dtype)

        for name in self._defaults:
            self._defaults[name] = moved(self._defaults[name])  # type: ignore[arg-type]  # no lists
            setattr(self, name, moved(getattr(self, name)))
        return self


def _bits(metric: PairMetric) -> Tensor:
    """Return 32 bits that stand for a metric's kind and options."""
    options = {name: value for name, value in vars(metric).items() if not name.startswith("_")}
    options.pop("training")
    told = crc32(repr((type(metric).__name__, sorted(options.items()))).encode())
    return torch.tensor([told >> bit & 1 for bit in range(32)])
