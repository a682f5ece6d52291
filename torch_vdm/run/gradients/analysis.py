"""The gradient of one step of `Haar`, worked out by hand: a synthesis.

A step is linear: its gradient needs none of its planes, and is a step in the other direction.
Autograd would fill and add a plane for every slice that the step reads.
"""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.cortex.border import Across, Down, analyse_at_border
from torch_vdm.model.cortex.haar import analyse
from torch_vdm.model.interleave import interleaved


def analysed(even: Tensor) -> tuple[Tensor, Tensor]:
    """Return `analyse`, with its gradient by hand."""
    found: tuple[Tensor, Tensor] = _Analysis.apply(even)
    return found


def analysed_at_border(even: Tensor, down: Down, across: Across) -> tuple[Tensor, Tensor, Tensor]:
    """Return `analyse_at_border`, with its gradient by hand."""
    found: tuple[Tensor, Tensor, Tensor] = _AnalysisAtBorder.apply(even, *down, *across)
    return found


class _Analysis(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, even: Tensor) -> tuple[Tensor, Tensor]:
        del ctx
        return analyse(even)

    @staticmethod
    def backward(ctx: Any, lowpass: Tensor, details: Tensor) -> Tensor:
        del ctx
        return synthesised(lowpass, details)


class _AnalysisAtBorder(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, even: Tensor, *weights: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(*weights)
        return analyse_at_border(even, Down(*weights[:2]), Across(*weights[2:]))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        weights: tuple[Tensor, ...] = ctx.saved_tensors
        return synthesised_at_border(*gradients, *weights[:3]), None, None, None, None


def synthesised(lowpass: Tensor, details: Tensor) -> Tensor:
    """Return the gradient of `analyse`, from those by what it returns."""
    mean = 0.25 * lowpass
    horizontal, vertical, diagonal = (0.25 * details).unbind(2)
    means = interleaved(mean + horizontal, mean - horizontal, -1)
    differences = interleaved(vertical + diagonal, vertical - diagonal, -1)
    return interleaved(means + differences, means - differences, -2)


def synthesised_at_border(
    lowpass: Tensor, details: Tensor, window: Tensor, down: Tensor, half: Tensor, across: Tensor
) -> Tensor:
    """Return the gradient of `analyse_at_border`, from those by what it returns.

    ``down``, ``half`` and ``across`` are the weights of `Down` and `Across`.
    """
    horizontal, *others = details.unbind(2)
    # Of the means of the siblings' own pixels, of those for the details, of the details.
    bottom = torch.stack((lowpass, window, horizontal), 1)
    between = down * bottom
    for variant, other in enumerate(others, 1):
        between[:, variant].addcmul_(half[:, 0], other)
    own, completed, detail = interleaved(between, bottom - between, -2).unbind(1)
    of_own, of_completed, of_detail = across.unbind(1)
    left = of_own * own
    left.addcmul_(of_completed, completed).addcmul_(of_detail, detail)
    return interleaved(left, own.add(completed).sub_(left), -1)
