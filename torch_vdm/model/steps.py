"""What the model says about how it is computed: only where an executor may take over."""

from collections.abc import Callable
from typing import Any

from torch import Tensor


class Steps:
    """Calls the steps of the model one after the other, unchanged; executors are subclasses."""

    cached: bool = False
    """Whether large planes are computed in parts that stay in a processor's cache."""

    @property
    def fused(self) -> bool:
        """Whether a step's operations are fused, so that a step for special cases costs more."""
        return False

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a pure function of planes returns; its first plane says how large it is."""
        return function(*arguments)

    def once(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return what a pure function returns whose operations take longer to call than to run.

        That is so of a few numbers, and on a GPU of most planes.
        """
        return function(*arguments)

    def valid(self, function: Callable[..., Any], around: Tensor, *arguments: Any) -> Any:
        """Return what a pure function returns of planes that come with their neighbours.

        Its planes are smaller by these, as those of a convolution that is called valid.
        """
        return function(around, *arguments)

    def padded(
        self,
        function: Callable[..., Any],
        pad: Callable[[Tensor, Any], Tensor],
        planes: Tensor,
        sides: Any,
        *arguments: Any,
    ) -> Any:
        """Return what a step returns of planes that ``pad`` has padded before."""
        return self(function, pad(planes, sides), *arguments)

    def pixels(self, function: Callable[..., Tensor], *planes: Tensor) -> Tensor:
        """Return the value of a pointwise function of pixels."""
        return function(*planes)

    def strips(
        self, function: Callable[[Tensor], tuple[Tensor, Tensor]], plane: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return `filtering`'s function of a plane: contrast, and lowpass at half the density.

        A place depends on those within `bands.REACH` of it.
        """
        return function(plane)

    def rows(self, height: int, numbers: int, most: int) -> int:
        """Return how many of ``height`` rows, of ``numbers`` elements in all, are computed at once.

        ``most``: how many elements at once are best where they should stay in a cache.
        """
        del numbers, most
        return height


PLAIN = Steps()
