"""The gradient of a level's local visual differences, worked out by hand.

Autograd keeps some thirty planes of a level for the backward pass. All of them follow from the
arguments: here only these are kept, and the rest is computed again, which costs less than storing
it. This is for the signed responses of nodes that do not overlap.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_vdm.model.contrast import LARGEST, local_contrast, opponents
from torch_vdm.model.distance import SMALLEST_DIFFERENCE
from torch_vdm.model.level import Sight
from torch_vdm.model.masking import masking_energy
from torch_vdm.model.matrix import mix
from torch_vdm.model.pooling import pool
from torch_vdm.model.quadtree import surround


def local_difference_by_hand(
    function: Callable[[Tensor, Tensor, Sight, Sight], Tensor],
    details: Tensor,
    others: Tensor,
    sight: Sight,
    other_sight: Sight,
    matrix: Tensor,
    masking: Tensor,
    summation: Tensor,
    cubes: bool,
) -> Tensor:
    """Return ``function`` of two images, their local visual difference, with its gradient by hand.

    Parameters
    ----------
    function
        From details and channel weightings to (B, 1, h, w), as `VDM` computes it.
    details, others, sight, other_sight
        Those of two images at a level.
    matrix
        (channels, 3), of Eq. 3.
    masking, summation
        The exponents of `unmasked` and of `local_visual_difference`.
    cubes
        Whether the latter is 6.
    """
    around = function, matrix, masking, summation, cubes
    local: Tensor = _LocalDifference.apply(*around, details, *sight, others, *other_sight)
    return local


class _LocalDifference(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[..., Tensor],
        matrix: Tensor,
        masking: Tensor,
        summation: Tensor,
        cubes: bool,
        *images: Tensor,
    ) -> Tensor:
        ctx.function, ctx.constants = function, (matrix, masking, summation, cubes)
        ctx.save_for_backward(*images)
        return _apply(function, images)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        images: tuple[Tensor, ...] = ctx.saved_tensors
        wanted: tuple[bool, ...] = ctx.needs_input_grad[5:]
        if torch.is_grad_enabled():
            # It will be differentiated again, so this is left to autograd.
            images = tuple(image if image is None else image.view_as(image) for image in images)
            inputs = [image for image, want in zip(images, wanted, strict=True) if want]
            local = _apply(ctx.function, images)
            found = iter(torch.autograd.grad(local, inputs, gradient, create_graph=True))
            slopes = [next(found) if want else None for want in wanted]
        else:
            slopes = _slopes(images, wanted, gradient, *ctx.constants)
        return None, None, None, None, None, *slopes


def _apply(function: Callable[..., Tensor], images: Sequence[Tensor]) -> Tensor:
    details, others = images[0], images[3]
    return function(details, others, Sight(*images[1:3]), Sight(*images[4:]))


def _slopes(
    images: Sequence[Tensor],
    wanted: Sequence[bool],
    gradient: Tensor,
    matrix: Tensor,
    masking: Tensor,
    summation: Tensor,
    cubes: bool,
) -> list[Tensor | None]:
    """Return the gradients with respect to those of the ``images`` that are ``wanted``."""
    one, other = (_weighted(image, matrix) for image in (images[:3], images[3:]))
    difference = one.weighted - other.weighted
    energy = pool(surround(difference * difference))
    masks = pool(surround(masking_energy(one.weighted, other.weighted))).add_(1.0)
    # The energy times the factor of `unmasked`; then its power of half the summation exponent.
    gain = torch.log2(masks).sub_(1.0).mul_(-2.0 * masking).exp2_()
    energy.mul_(gain)
    if cubes:
        slope = energy * energy
    else:
        slope = (
            torch.log2(energy.clamp_min(SMALLEST_DIFFERENCE)).mul_(0.5 * summation - 1.0).exp2_()
        )
    # The slope of a square is twice its root.
    slope.mul_(gradient.unsqueeze(2) * summation)
    # With a repeated border the box is its own transpose.
    hidden = (slope * energy).sum(2, keepdim=True).mul_(-2.0 * masking).div_(masks)
    by_square = pool(surround(hidden))
    by_difference = pool(surround(slope.mul_(gain))).mul_(difference)
    return [
        *_by_image(images[:3], one, by_difference, by_square, matrix, wanted[:3]),
        *_by_image(images[3:], other, by_difference.neg_(), by_square, matrix, wanted[3:]),
    ]


class _Path(NamedTuple):
    """The steps from the details of an image to its weighted contrast, (B, 3, ., h, w)."""

    contrast: Tensor
    opponent: Tensor
    weighted: Tensor


def _weighted(image: Sequence[Tensor], matrix: Tensor) -> _Path:
    """Return the path of an image."""
    details, scale, sensitivity = image
    if scale is None:  # one plane of a grey image: the sensitivity has the rest
        return _Path(details, details, details * sensitivity)
    contrast = local_contrast(details, scale)
    opponent = opponents(contrast, matrix)
    return _Path(contrast, opponent, opponent * sensitivity)


def _by_image(
    image: Sequence[Tensor],
    path: _Path,
    by_difference: Tensor,
    by_square: Tensor,
    matrix: Tensor,
    wanted: Sequence[bool],
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Return the gradients by details, scale and sensitivity; only those ``wanted`` are computed.

    ``by_difference`` is the gradient by the weighted contrast through the difference, ``by_square``
    that through the masking, divided by the contrast. The planes of ``path`` are overwritten.
    """
    if not any(wanted):
        return None, None, None
    details, scale, sensitivity = image
    by_weighted = path.weighted.mul_(by_square).add_(by_difference)
    if scale is None:
        of_grey = (by_weighted * factor for factor in (sensitivity, details))
        by_details, by_sensitivity = (
            product.sum_to_size(sized.shape) if want else None
            for product, sized, want in zip(
                of_grey, (details, sensitivity), wanted[::2], strict=True
            )
        )
        return by_details, None, by_sensitivity
    by_sensitivity = None
    if wanted[2]:
        by_sensitivity = path.opponent.mul_(by_weighted).sum_to_size(sensitivity.shape)
    by_contrast = mix(matrix.T, by_weighted.mul_(sensitivity))
    # 0 where the contrast was kept `within` its limit.
    by_contrast = torch.ops.aten.hardtanh_backward(by_contrast, path.contrast, -LARGEST, LARGEST)
    by_scale = (by_contrast * details).sum(2) if wanted[1] else None
    by_details = by_contrast.mul_(scale.unsqueeze(2)) if wanted[0] else None
    return by_details, by_scale, by_sensitivity
