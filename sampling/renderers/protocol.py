"""The contract between the adaptive sampler and a renderer."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray


class Samples(NamedTuple):
    """Radiance samples of some pixels."""

    pixels: NDArray[np.int64]
    """(N,), the pixel of each sample, row by row from the top left; sorted."""
    radiance: NDArray[np.float32]
    """(N, 3), linear BT.709."""


class Renderer(Protocol):
    """Draws samples of single pixels, independent of each other.

    Sample k of a pixel is a function of the pixel, k and the seed alone: it is the same in whatever
    order, batch or round it is drawn.
    """

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the image in pixels."""

    def sample(
        self, pixels: NDArray[np.int64], first: NDArray[np.int64], count: NDArray[np.int64]
    ) -> Samples:
        """Draw samples ``first[i]`` to ``first[i] + count[i] - 1`` of each of ``pixels``."""
