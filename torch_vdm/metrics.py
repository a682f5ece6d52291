"""The metric as a `torchmetrics.Metric`, for training loops and Lightning.

torchmetrics is not among the package's requirements: ``pip install torchmetrics``.
"""

from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torch_vdm.display import Display
from torch_vdm.distance import VISIBLE
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
    ``self.log("jnd", metric)`` takes it. The states are sums, a count and a
    maximum, in float64: batches, devices and processes add up to what one pass would give, and no
    image is kept.

    Parameters
    ----------
    ppd, display
        As in `VDM`.
    vdm_options
        More for `VDM`, by name.
    figure
        The one to compute, as a tensor; None: all three.
    options
        For `torchmetrics.Metric`.

    Raises
    ------
    ValueError
        Where a parameter or an image is not as stated.
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False

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
        **options: Any,
    ) -> None:
        if figure not in (None, *FIGURES):
            raise ValueError(f"expected a figure of {', '.join(FIGURES)}, got {figure!r}")
        super().__init__(**options)
        self.figure = figure
        self.vdm = VDM(ppd, display, **(vdm_options or {}))
        zero = torch.zeros((), dtype=torch.float64)
        for name in ("pixels", "jnd", "visible"):
            self.add_state(name, zero.clone(), dist_reduce_fx="sum")
        self.add_state("largest", zero.clone(), dist_reduce_fx="max")

    @torch.no_grad()
    def update(self, test: Tensor, reference: Tensor) -> None:
        """Add a batch, (B, 3, H, W) and (B, 3, H, W); sizes may differ between batches."""
        jnd = self.vdm(test, reference).double()
        self.pixels += jnd.numel()
        self.jnd += jnd.sum()
        self.visible += (jnd > VISIBLE).sum()
        self.largest = torch.maximum(self.largest, jnd.max())

    def compute(self) -> dict[str, Tensor] | Tensor:
        """Return mean_jnd, max_jnd and visible_fraction of everything added, or one of them."""
        figures = (self.jnd / self.pixels, self.largest, self.visible / self.pixels)
        found = dict(zip(FIGURES, figures, strict=True))
        return found if self.figure is None else found[self.figure]
