"""What every cortex transform is held to."""

from typing import NamedTuple, Protocol

from torch import Tensor


class Cortex(NamedTuple):
    """The cortex representation of a batch of images; level 0 is the root.

    Attributes
    ----------
    details
        One tensor a level, (B, cones, orientations, h, w): the detail coefficients.
    lowpass
        One tensor a level, (B, cones, h, w): the lowpass coefficients of the same nodes. An
        image of one pixel has no details and one lowpass, itself.
    mean
        (B, cones, 1, 1), the mean of the image. Not the root's lowpass, in which the repeated
        border of an odd side may count for more than it is.
    """

    details: tuple[Tensor, ...]
    lowpass: tuple[Tensor, ...]
    mean: Tensor

    def parent_lowpass(self, level: int) -> Tensor:
        """Return the lowpass one level up from ``level``; the root's is its own."""
        return self.lowpass[max(level - 1, 0)]


class Transform(Protocol):
    """A decomposition into levels on a quad-tree, and what each level responds to."""

    def decompose(self, planes: Tensor, fast: bool = False, true_means: bool = False) -> Cortex:
        """Decompose (B, C, H, W) to the coarsest level, by compiled steps if ``fast``.

        ``true_means``: no pixel counts for more than another, at the border of an odd side too.
        """

    def peak(self, level_from_finest: int) -> tuple[float, float]:
        """Return the best frequency of a level, in cycles/pixel, and the gain there."""
