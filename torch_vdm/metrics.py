"""The metric as a `torchmetrics.Metric`, for training loops and Lightning.

torchmetrics is not among the package's requirements: ``pip install torchmetrics``.
"""

from typing import Any

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


class VisualDifference(Metric):
    """Visible differences over a data set.

    `compute` returns a dictionary of 0-dim tensors: ``mean_jnd`` over all pixels, ``max_jnd``, and
    ``visible_fraction``, the share of pixels over 1 JND. The states are sums, a count and a
    maximum, in float64: batches, devices and processes add up to what one pass would give, and no
    image is kept.

    Parameters
    ----------
    ppd, display, options
        As in `VDM`; other options go to `torchmetrics.Metric`.
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
        **options: Any,
    ) -> None:
        super().__init__(**options)
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

    def compute(self) -> dict[str, Tensor]:
        """Return mean_jnd, max_jnd and visible_fraction of everything added."""
        return {
            "mean_jnd": self.jnd / self.pixels,
            "max_jnd": self.largest,
            "visible_fraction": self.visible / self.pixels,
        }
