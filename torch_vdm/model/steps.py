"""What the model says of how it is computed: nothing but where an executor may take over."""

from collections.abc import Callable
from typing import Any

from torch import Tensor


class Steps:
    """Calls the steps of the model one after the other, each as it is; executors derive others."""

    cached: bool = False
    """Whether large planes are computed in parts that stay in a processor's cache."""

    @property
    def fused(self) -> bool:
        """Whether the operations of a step become one, and a step for special cases costs more."""
        return False

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a pure function of planes returns; the first plane tells how large it is."""
        return function(*arguments)

    def pixels(self, function: Callable[..., Tensor], *planes: Tensor) -> Tensor:
        """Return a function of pixels, of which none depends on another."""
        return function(*planes)

    def strips(
        self, function: Callable[[Tensor], tuple[Tensor, Tensor]], plane: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return `filtering`'s function of a plane: contrast, and lowpass at half the density.

        A place depends on those up to `bands.REACH` from it.
        """
        return function(plane)

    def rows(self, height: int, numbers: int, most: int) -> int:
        """Return how many of ``height`` rows, ``numbers`` numbers in all, are computed at once.

        ``most``: a good number of numbers at once, where these are to stay in a cache.
        """
        del numbers, most
        return height


PLAIN = Steps()
