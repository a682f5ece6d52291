"""What every cortex transform is held to."""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

from torch import Tensor

from torch_vdm.model.grid import PAPERS, Before, Grid
from torch_vdm.model.quadtree import apart, together
from torch_vdm.model.steps import PLAIN, Steps
from torch_vdm.options import choice
from torch_vdm.precision import widest

# Levels that constants are made for: an image of 2^24 pixels a side.
DEEPEST = 24

# Where contrast sensitivity acts: on the levels of a transform, or on the image before it.
CSF = Literal["levels", "filter"]


def checked_csf(csf: str) -> None:
    """Raise ValueError where ``csf`` is none of the two."""
    choice("csf", csf, get_args(CSF))


class Cortex(NamedTuple):
    """The cortex representation of a batch of images; level 0 is the root.

    Attributes
    ----------
    details
        One tensor a level, (B, cones, orientations, h, w): the detail coefficients.
    lowpass
        One tensor a level, (B, cones, h, w): the lowpass coefficients of the same nodes. An
        image of one pixel has no details and one lowpass, itself. Of a filtered image, in which
        nothing is adapted to them any more, a transform may leave them out.
    mean
        (B, cones, 1, 1), the mean of the image. Not the root's lowpass, in which the repeated
        border of an odd side may count for more than it is.
    finest
        How many levels finer than these the image has; see `Transform.resume`.
    items
        How many images lie below one another in every plane; where there are several, B is 1.
    grid
        Where the nodes lie on the image.
    windows
        One tensor a level, (B, cones, h, w): the means of all that the nodes' details are made of,
        to which the eye is adapted one level down. None where this is their lowpass.
    """

    details: tuple[Tensor, ...]
    lowpass: tuple[Tensor, ...]
    mean: Tensor
    finest: int = 0
    items: int = 1
    grid: Grid = PAPERS
    windows: tuple[Tensor, ...] | None = None

    @property
    def before(self) -> tuple[Before, ...]:
        """What is put before the first node of each level where it has its parents."""
        return self.grid.down(len(self.details), self.finest)

    def parent_lowpass(self, level: int) -> Tensor:
        """Return the lowpass one level up from ``level``, of windows; the root's is its own."""
        return (self.windows or self.lowpass)[max(level - 1, 0)]

    def each(self, function: Callable[..., Tensor], *others: "Cortex") -> "Cortex":
        """Return the representation with every plane as a function makes it, of the others' too."""
        all_of = (self, *others)

        def of_levels(*planes: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            return tuple(function(*level) for level in zip(*planes, strict=True))

        return self._replace(
            details=of_levels(*(one.details for one in all_of)),
            lowpass=of_levels(*(one.lowpass for one in all_of)),
            mean=function(*(one.mean for one in all_of)),
            windows=self.windows and of_levels(*(one.windows or one.lowpass for one in all_of)),
        )


class Base(NamedTuple):
    """What the coarser levels of an image are decomposed from.

    Attributes
    ----------
    plane
        (B, C, h, w), the image at 1 / 2^octaves of its sides, rounded up.
    octaves
        0 for the image itself.
    size
        (H, W) of the image.
    mean
        (B, C, 1, 1), that of the image.
    """

    plane: Tensor
    octaves: int
    size: tuple[int, int]
    mean: Tensor


@runtime_checkable
class Transform(Protocol):
    """A decomposition into levels on a quad-tree, and what each level responds to."""

    @property
    def shifts(self) -> int:
        """How many nodes a level has, in x and in y, in the width of one.

        1: nodes lie side by side, the finest 2 pixels wide, and the quad-tree is the paper's. 2:
        they overlap, and the quad-tree is that of the halves of nodes, whose leaves are the pixels.
        The half of a node (y, x) is covered by the nodes y - 1 and y, x - 1 and x.
        """

    @property
    def csf(self) -> CSF:
        """Where contrast sensitivity acts.

        "levels": on the details, at each level's frequency. "filter": on the image, at every
        frequency; what is decomposed is then no light but weighted contrast, A, C1 and C2 for the
        cones, and a level only divides it by its gains.
        """

    @property
    def phases(self) -> int:
        """How many successive planes of details are phases of one: 1, or 2 for even and odd."""

    @property
    def reach(self) -> int:
        """How many nodes around a node, to each side, hold all that it and its parent are made of.

        Nodes of its own level; what lies further off changes neither its details nor its parent's
        lowpass.
        """

    def grid(self, size: tuple[int, int], true_means: bool) -> Grid:
        """Return where the nodes lie on an image of ``size``, for parents and for paths.

        With ``true_means`` as `decompose` takes it.
        """

    def decompose(
        self,
        planes: Tensor,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,
    ) -> Cortex:
        """Decompose (B, C, H, W) to the coarsest level, step by step.

        ``true_means``: no pixel counts for more than another, at the border of an odd side too.
        ``grid``: that of a part of an image, a `Grid.part`; by default that of an image of this
        size.
        """

    def reduced(
        self,
        planes: Tensor,
        octaves: int,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,
    ) -> Tensor:
        """Return (B, C, H, W) at 1 / 2^octaves of its sides, rounded up: what `resume` takes."""

    def resume(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Return the levels of `decompose` without its ``base.octaves`` + 1 finest.

        From what `reduced` gives, so that an image larger than memory is decomposed in tiles.
        """

    def begin(
        self,
        planes: Tensor,
        count: int,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,
    ) -> tuple[Cortex, Tensor]:
        """Return the ``count`` finest levels of `decompose`, 3 or more, and what `rest` needs.

        That is the image at 1 / 2^(count - shifts) of its sides. So a large image is decomposed in
        strips; a strip's mean is none.
        """

    def rest(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Return the levels of `decompose` without its ``count`` - 1 finest.

        The plane of ``base`` is put together from those that `begin` gives of all strips.
        """

    def peaks(self, level_from_finest: int) -> tuple[tuple[float, float], ...]:
        """Return the best frequency of a level, in cycles/pixel, and the gain there.

        For each orientation, or one for all of them.
        """


def mean_of(planes: Tensor, items: int = 1) -> Tensor:
    """Return the mean of (B, C, H, W), (B, C, 1, 1), good to its last bit in any size.

    Of ``items`` images below one another, (1, C, items H, W), that of each, (1, C, items, 1).

    The lowpass term takes the difference of two of them, 76 times and more: the rounding of a sum
    over millions of pixels would be seen.
    """
    rows = planes.mean(-1, keepdim=True).to(widest(planes.device))
    if items > 1:
        return together(apart(rows, items).mean(-2, keepdim=True)).to(planes)
    return rows.mean(-2, keepdim=True).to(planes)
