"""The metric as a training loss."""

import math
from dataclasses import replace
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from torch_vdm.model.cortex import Haar
from torch_vdm.model.display import Display, codes
from torch_vdm.model.distance import just_noticeable
from torch_vdm.observer import Observer
from torch_vdm.options import choice, number, switch
from torch_vdm.run import operators
from torch_vdm.vdm import VDM

Reduction = Literal["mean", "sum", "none"]

# Weight of the L1 term. Status: choice, by experiment: of 0, 30, 60, 120, 240 and 360, the one with
# which 300 steps of Adam on its pixels bring a picture back under 1 JND everywhere with room to
# spare, starting from noise, from flat grey, black and white, and from a shift by 8 pixels.
L1 = 360.0


# The dark light of the loss's observer, cd/m2: as of a screen in a lit room, several hundred
# times the eye's own. A step away from black then has no contrast of hundreds: 300 steps of Adam
# lead from black to the picture with the metric alone; with 0.02 they do not. Status: choice,
# measured.
DARK_LIGHT = 0.2


# The power of the map whose logarithm is the loss: smooth at 0, and about even up to 1 JND. Status:
# choice, that of Eq. 5.
EXPONENT = 2.4


class VDMLoss(operators.Enrolled):
    """A perceptual loss: the mean of log(1 + p), and an L1 term.

    p is the map of `VDM` to the power of 2.4: smooth, 0 with gradient 0 where the images are equal.
    The logarithm keeps regions far above threshold from drowning out the rest: near threshold
    the loss orders images as the map does; far above, it grows with the logarithm of the JND.

    The L1 term is the mean absolute difference of sRGB-coded values (of light relative to the
    display's white, for a display that takes light). It recovers what nobody sees, such as detail
    beyond the eye's resolution, and finds the way where the metric alone has local minima.

    The loss is finite, with a finite gradient, for every finite image. A gradient that a
    half-precision image cannot hold arrives as infinity, which makes `torch.amp.GradScaler` lower
    its scale.

    Parameters
    ----------
    ppd, display, options
        As in `VDM`, except that the default observer is the calibrated one in a lit room, with
        several hundred times its dark light, and called "lit room": otherwise a step away from
        black could be seen at any contrast.
    l1
        Weight of the L1 term; 0: the metric alone.
    reduction
        Over the batch: "mean", "sum", or "none" for one value per item, (B,).
    checkpoint
        Whether to keep less for the backward pass and recompute it there: about a third less
        memory for up to a quarter more time, with the same gradients. Not with `torch.func`.

    Raises
    ------
    ValueError
        If a parameter or an image is not as stated.
    """

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        l1: float = L1,
        reduction: Reduction = "mean",
        checkpoint: bool = False,
        **options: Any,
    ) -> None:
        super().__init__()
        choice("reduction", reduction, get_args(Reduction))
        l1 = number("l1", l1)
        if not (math.isfinite(l1) and l1 >= 0.0):
            raise ValueError(f"expected a weight l1 of 0 or more, got {l1}")
        if options.get("observer") is None:
            # Fitted before it gets a name of its own.
            observer = Observer.calibrated().fitted_to(options.get("transform") or Haar())
            options["observer"] = replace(observer, name="lit room", dark_light=DARK_LIGHT)
        self.metric = VDM(ppd, display, **options)
        # An image that is not trained yet may have any values; its target may not.
        self.metric._out_of_range_in = all
        self.metric._checkpointed = switch("checkpoint", checkpoint)
        self.l1 = l1
        self.reduction = reduction

    def forward(self, test: Tensor, reference: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the loss of (B, 3, H, W) against (B, 3, H, W).

        ``mask`` (B, 1, H, W) weights the pixels, 0 to leave one out; a pixel that is left out
        is still the background of its neighbours. A weight that is not finite or below 0 is a
        ValueError, for which one number is read back from the device. With ``nonfinite="mask"``,
        or in a graph of torch.export, nothing is read back, and the loss is NaN.
        """
        by_mask = isinstance(mask, Tensor) and mask.requires_grad
        if operators.is_wanted() and self.metric._has_own_constants() and not by_mask:
            items = operators.loss_of_items(test, reference, mask, self._number)
        else:
            items = self.of_items(test, reference, mask)
        if self.reduction == "mean":
            return items.mean()
        return items.sum() if self.reduction == "sum" else items

    def of_items(self, test: Tensor, reference: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the loss of every item, (B,); arguments as in `forward`."""
        test, reference, seen = self.metric._checked(test, reference, later=True)
        # The L1 term first: its intermediate results are freed before the metric needs most memory.
        l1 = self._in_rows(test, reference) if self.l1 else 0.0
        power = self.metric._power(test, reference, seen)
        exponent = self.metric.observer.summation_exponent / EXPONENT
        once = self.metric.scheduled(test, reference).once
        items: Tensor
        if mask is None:
            items = once(mean_of_items, power, exponent, l1, self.l1)
        else:
            items = self._weighted(once(of_pixels, power, exponent, l1, self.l1), mask)
        self.metric._require_finite_later(test, reference)
        return items

    def compile(self, *args: Any, **kwargs: Any) -> Self:  # type: ignore[override]
        """Switch the metric to its compiled route, `VDM.compile`."""
        self.metric.compile(*args, **kwargs)
        return self

    def _in_rows(self, test: Tensor, reference: Tensor) -> Tensor:
        """Return `absolute_difference`, on a processor a few rows at a time on every route."""
        schedule = self.metric.scheduled(test, reference)
        if schedule.cached:
            schedule = replace(schedule, compiled=False)
        scale = self.metric.display.white_scale(test)
        return schedule.pixels(
            lambda *part: schedule.once(absolute_difference, *part, scale), test, reference
        )

    def _weighted(self, plane: Tensor, mask: Tensor) -> Tensor:
        """Return the mean of every item, (B,), weighted by a mask."""
        if not isinstance(mask, Tensor) or mask.shape != plane.shape:
            got = tuple(mask.shape) if isinstance(mask, Tensor) else type(mask).__name__
            raise ValueError(f"expected a mask of shape {tuple(plane.shape)}, got {got}")
        weights = mask.to(plane)
        right = weights.isfinite() & (weights >= 0.0)
        if self.metric._reads(weights) and not bool(right.all()):
            raise ValueError("expected finite mask values of 0 or more, got others; clamp the mask")
        weights = torch.where(right, weights, torch.nan)
        return (plane * weights).sum((1, 2, 3)) / weights.sum((1, 2, 3)).clamp_min(
            torch.finfo(plane.dtype).tiny
        )


def absolute_difference(test: Tensor, reference: Tensor, scale: Tensor | None) -> Tensor:
    """Return the mean absolute difference of sRGB-coded values, (B, 1, H, W).

    ``scale`` is the display's `Display.white_scale`.
    """
    return (codes(test, scale) - codes(reference, scale)).abs().mean(1, keepdim=True)


def of_pixels(power: Tensor, exponent: float, absolute: Tensor | float, l1: float) -> Tensor:
    """Return the loss of every pixel, (B, 1, H, W).

    ``power`` is the map to a power, ``absolute`` the `absolute_difference`, weighted by ``l1``.
    """
    return torch.log1p(just_noticeable(power, exponent)) + l1 * absolute


def mean_of_items(power: Tensor, exponent: float, absolute: Tensor | float, l1: float) -> Tensor:
    """Return the mean of every item, (B,), of what `of_pixels` returns."""
    return of_pixels(power, exponent, absolute, l1).mean((1, 2, 3))
