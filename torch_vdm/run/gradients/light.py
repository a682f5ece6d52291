"""The gradients of linear values and of cone responses by pixel values, worked out by hand.

Only the image is kept: autograd would keep seven planes of its size, and pass over them thirty
times.
"""

from typing import Any

import torch
from torch import Tensor

from torch_vdm.model.cones import pixels_to_cones
from torch_vdm.model.display import (
    LARGEST_CODE,
    SRGB_EXPONENT,
    SRGB_KNEE,
    SRGB_OFFSET,
    SRGB_SLOPE,
    linear_values,
)
from torch_vdm.model.matrix import mix


def linear_by_hand(image: Tensor, encoding: str, limit: Tensor | None) -> Tensor:
    """Return `linear_values`, with its gradient by hand."""
    values: Tensor = _LinearValues.apply(image, encoding, limit)
    return values


def cones_by_hand(image: Tensor, encoding: str, limit: Tensor | None, matrix: Tensor) -> Tensor:
    """Return `pixels_to_cones`, with its gradient by hand."""
    if matrix.requires_grad:
        return pixels_to_cones(image, encoding, limit, matrix)
    cones: Tensor = _Mixed.apply(linear_by_hand(image, encoding, limit), matrix)
    return cones


class _LinearValues(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, encoding: str, limit: Tensor | None) -> Tensor:
        ctx.save_for_backward(image, limit)
        ctx.encoding = encoding
        values = linear_values(image, encoding, limit)
        return values.clone() if values is image else values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        image, limit = ctx.saved_tensors
        if torch.is_grad_enabled():
            # It will be differentiated again, so this is left to autograd.
            values = linear_values(image, ctx.encoding, limit)
            (slope,) = torch.autograd.grad(values, image, gradient, create_graph=True)
            return slope, None, None
        return _slope(image, ctx.encoding, limit).mul_(gradient), None, None


def _slope(image: Tensor, encoding: str, limit: Tensor | None) -> Tensor:
    """Return the derivative of `linear_values` at every value."""
    slope = torch.ones_like(image) if encoding != "srgb" else _slope_of_srgb(image)
    if limit is None:
        return slope
    return slope.mul_(linear_values(image, encoding, None).abs() <= limit)


def _slope_of_srgb(image: Tensor) -> Tensor:
    scale = 1.0 / (1.0 + SRGB_OFFSET)
    base = image.clamp(SRGB_KNEE, LARGEST_CODE).add_(SRGB_OFFSET).mul_(scale)
    slope = base.log2_().mul_(SRGB_EXPONENT - 1.0).exp2_().mul_(SRGB_EXPONENT * scale)
    return slope.masked_fill_(image <= SRGB_KNEE, 1.0 / SRGB_SLOPE).mul_(image.abs() < LARGEST_CODE)


class _Mixed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, planes: Tensor, matrix: Tensor) -> Tensor:
        ctx.save_for_backward(matrix)
        return mix(matrix, planes)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (matrix,) = ctx.saved_tensors
        return mix(matrix.T, gradient), None
