"""The Haar tree of variances, and the two boundary images.

"Refine error estimate" and "construct boundary images" of Fig. 8.
"""

import torch
from torch import Tensor

from torch_vdm.cortex import Cortex
from torch_vdm.quadtree import pad_even

# Distance of the quartiles of a normal distribution from its mean, in standard deviations.
QUARTILE = 0.6744897501960817

# A variance of nothing, in cone responses squared. Status: choice.
NONE = 1e-200


def detail_variances(leaves: Tensor) -> tuple[Tensor, ...]:
    """Return the variances of the detail coefficients of independent leaves (Section 3).

    The variance of an interior node is the sum of its four children's over 16; its details have
    the same. Where an odd side repeats its last row or column, the two copies are one number: what
    they add to counts twice its deviation, and what subtracts them has no variance.

    Parameters
    ----------
    leaves
        (B, C, H, W), not negative.

    Returns
    -------
    tuple of Tensor
        One (B, C, 3, h, w) a level, level 0 first: d1 (horizontal), d2 (vertical), d3 (diagonal).
    """
    levels: list[Tensor] = []
    nodes = leaves
    while max(nodes.shape[-2:]) > 1:
        height, width = nodes.shape[-2:]
        even = pad_even(nodes)
        rows = even[..., 0::2, :] + even[..., 1::2, :]
        lowpass = (rows[..., 0::2] + rows[..., 1::2]) / 16.0
        if height % 2:
            lowpass[..., -1, :] *= 2.0
        if width % 2:
            lowpass[..., -1] *= 2.0
        details = lowpass.unsqueeze(2).repeat(1, 1, 3, 1, 1)
        if height % 2:
            details[:, :, 1:, -1] = 0.0
        if width % 2:
            details[:, :, 0::2, :, -1] = 0.0
        levels.append(details)
        nodes = lowpass
    return tuple(reversed(levels))


def boundaries(
    cortex: Cortex,
    variances: tuple[Tensor, ...],
    mean_variance: Tensor,
    spread: float,
    signed: bool,
) -> tuple[Cortex, Cortex]:
    """Return the lower and the upper boundary image of a representation.

    Details ``spread`` standard deviations below and above: the paper's 25 % and 75 % points with
    `QUARTILE`. Their lowpass is that of ``cortex``; the mean, which the calibrated observer
    compares, spreads as the details do.

    Parameters
    ----------
    cortex
        The current means, in cone space.
    variances
        Of its details, as `detail_variances` gives them.
    mean_variance
        (B, C, 1, 1), of the mean of the image.
    spread
        In standard deviations.
    signed
        False, for an observer of magnitudes: abs(d) - spread sigma, not below 0, with the sign of
        d. True: the boundary crosses zero, so that a small detail spreads as far as a large one.
    """
    lower: list[Tensor] = []
    upper: list[Tensor] = []
    for detail, variance in zip(cortex.details, variances, strict=True):
        # Not 0, for the slope of its root there is infinite.
        margin = spread * variance.clamp_min(NONE).sqrt()
        if signed:
            lower.append(detail - margin)
            upper.append(detail + margin)
        else:
            # Not torch.sign, for a detail of 0 spreads too.
            sign = torch.where(detail < 0.0, -1.0, 1.0)
            size = detail.abs()
            lower.append(sign * (size - margin).clamp_min(0.0))
            upper.append(sign * (size + margin))
    margin = spread * mean_variance.clamp_min(NONE).sqrt()
    return (
        cortex._replace(details=tuple(lower), mean=cortex.mean - margin),
        cortex._replace(details=tuple(upper), mean=cortex.mean + margin),
    )
