"""The lowpass term: how different the means of two images look. A uniform change is seen here."""

from torch import Tensor

from torch_vdm.model.contrast import opponents, weber_contrast
from torch_vdm.model.distance import LARGEST_DIFFERENCE


def lowpass_difference(
    first: Tensor, second: Tensor, dark_light: Tensor, matrix: Tensor, gains: Tensor
) -> Tensor:
    """Return the weighted contrast between two means, (B, channels, 1, 1), 1 at threshold.

    Parameters
    ----------
    first, second
        (B, 3, 1, 1), cone responses.
    dark_light, matrix
        As in `weber_contrast` and `opponents`.
    gains
        (channels,): the sensitivity of each channel. Status: choice, see `Observer.lowpass_gains`.
    """
    contrast = weber_contrast(first, second, dark_light)
    weighted = opponents(contrast, matrix) * gains.view(-1, 1, 1)
    return weighted.abs().clamp_max(LARGEST_DIFFERENCE)


def root(
    first: Tensor,
    second: Tensor,
    dark_light: Tensor,
    matrix: Tensor,
    gains: Tensor,
    exponent: Tensor,
) -> Tensor:
    """Return what every path of the quad-tree starts from, (B, 1, 1, 1): the term's power."""
    seen = lowpass_difference(first, second, dark_light, matrix, gains)
    return (seen**exponent).sum(1, keepdim=True)
