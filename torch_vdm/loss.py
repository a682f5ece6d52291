"""The metric as a training loss."""

from typing import Any, Literal

from torch import Tensor, nn

from torch_vdm.display import Display
from torch_vdm.vdm import VDM

Reduction = Literal["mean", "sum", "none"]


class VDMLoss(nn.Module):
    """The mean over all pixels of the map to the power of 2.4: before the root.

    Finite with a finite gradient for every finite image; 0 with gradient 0 for equal images.

    Parameters
    ----------
    ppd, display, options
        As in `VDM`.
    reduction
        Over the batch: "mean", "sum", or "none" for one value an item, (B,).
    """

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        reduction: Reduction = "mean",
        **options: Any,
    ) -> None:
        super().__init__()
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f'expected reduction "mean", "sum" or "none", got {reduction!r}')
        self.metric = VDM(ppd, display, **options)
        self.reduction = reduction

    def forward(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return the loss of (B, 3, H, W) against (B, 3, H, W)."""
        items = self.metric.power(test, reference).mean((1, 2, 3))
        if self.reduction == "mean":
            return items.mean()
        return items.sum() if self.reduction == "sum" else items
