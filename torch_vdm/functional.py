"""The metric and the loss as functions; the modules behind them are made once and cached."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torch_vdm.loss import VDMLoss
from torch_vdm.vdm import VDM

# How many modules are cached, one for each set of options and device. Status: choice.
MOST_KEPT = 32


def visual_difference(test: Tensor, reference: Tensor, ppd: float = 60.0, **options: Any) -> Tensor:
    """Return the map of visible differences, (B, 1, H, W) in JND, as `VDM` does.

    Parameters
    ----------
    test, reference
        (B, 3, H, W), floating point, as the display expects them.
    ppd
        Pixels in one degree of the visual field.
    options
        Those of `VDM`, by name: display, observer, transform, effects, nonfinite.

    Raises
    ------
    ValueError
        If an option or an image is not as stated.
    """
    seen: Tensor = _module(VDM, test, ppd, options)(test, reference)
    return seen


def visual_difference_loss(
    test: Tensor,
    reference: Tensor,
    ppd: float = 60.0,
    mask: Tensor | None = None,
    **options: Any,
) -> Tensor:
    """Return the perceptual loss, as `VDMLoss` does.

    Parameters
    ----------
    test, reference, ppd
        As in `visual_difference`.
    mask
        (B, 1, H, W), weights of the pixels.
    options
        Those of `VDMLoss`, by name: l1, reduction, checkpoint, and those of `VDM`.

    Returns
    -------
    Tensor
        A scalar, or (B,) with ``reduction="none"``.

    Raises
    ------
    ValueError
        If an option or an image is not as stated.
    """
    loss: Tensor = _module(VDMLoss, test, ppd, options)(test, reference, mask)
    return loss


def _module(kind: Callable[..., Any], image: Tensor, ppd: float, options: dict[str, Any]) -> Any:
    device = image.device if isinstance(image, Tensor) else torch.device("cpu")
    try:
        return _kept(kind, device, ppd, **options)
    except TypeError:  # an option that is not hashable: the module says what is wrong with it
        return kind(ppd, **options).to(device)


@lru_cache(MOST_KEPT)
def _kept(kind: Callable[..., Any], device: torch.device, ppd: float, **options: Any) -> Any:
    return kind(ppd, **options).to(device)
