"""The interface of every cortex transform."""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

from torch import Tensor

from torch_vdm.model.grid import PAPERS, Before, Grid
from torch_vdm.model.steps import PLAIN, Steps
from torch_vdm.options import choice
from torch_vdm.precision import widest

# The number of levels that constants are made for: an image of 2^24 pixels a side.
DEEPEST = 24

# Where contrast sensitivity acts: on the levels of a transform, or on the image before it.
CSF = Literal["levels", "filter"]


def checked_csf(csf: str) -> None:
    """Raise ValueError if ``csf`` is neither of the two."""
    choice("csf", csf, get_args(CSF))


class Cortex(NamedTuple):
    """The cortex representation of a batch of images; level 0 is the root.

    Attributes
    ----------
    details
        One tensor per level, (B, cones, orientations, h, w): the detail coefficients.
    lowpass
        One tensor per level, (B, cones, h, w): the lowpass coefficients of the same nodes. An
        image of one pixel has no details and one lowpass, itself. For a filtered image, where
        nothing is adapted to them any more, a transform may leave these out.
    mean
        (B, cones, 1, 1), the mean of the image. This is not the root's lowpass, in which the
        repeated border of an odd side may count for too much.
    finest
        How many levels finer than these the image has; see `Transform.resume`.
    grid
        Where the nodes lie on the image.
    windows
        One tensor per level, (B, cones, h, w): the means of all that the nodes' details are
        computed from. The eye is adapted to them one level down. None if they are the lowpass.
    """

    details: tuple[Tensor, ...]
    lowpass: tuple[Tensor, ...]
    mean: Tensor
    finest: int = 0
    grid: Grid = PAPERS
    windows: tuple[Tensor, ...] | None = None

    @property
    def before(self) -> tuple[Before, ...]:
        """How many nodes are put before the first of each level to find their parents."""
        return self.grid.down(len(self.details), self.finest)

    def parent_lowpass(self, level: int) -> Tensor:
        """Return the lowpass of windows one level up from ``level``; the root's is its own."""
        return (self.windows or self.lowpass)[max(level - 1, 0)]

    def each(self, function: Callable[..., Tensor], *others: "Cortex") -> "Cortex":
        """Return the representation with a function applied to every plane and those of others."""
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
        """How many nodes a level has per node width, in x and in y: its oversampling.

        1: nodes lie side by side, the finest 2 pixels wide, and the quad-tree is the paper's. 2:
        they overlap, and the quad-tree is that of half nodes, whose leaves are the pixels. The
        half node (y, x) is covered by the nodes y - 1 and y, x - 1 and x.
        """

    @property
    def csf(self) -> CSF:
        """Where contrast sensitivity acts.

        "levels": on the details, at each level's frequency. "filter": on the image, at every
        frequency; what is decomposed is then not light but weighted contrast, A, C1 and C2 in place
        of the cones, and a level only divides it by its gains.
        """

    @property
    def phases(self) -> int:
        """How many successive planes of details are phases of one: 1, or 2 for even and odd."""

    @property
    def reach(self) -> int:
        """The radius, in nodes of its own level, of all that a node and its parent depend on.

        What lies further away changes neither its details nor its parent's lowpass.
        """

    def grid(self, size: tuple[int, int], true_means: bool) -> Grid:
        """Return where the nodes lie on an image of ``size``, for parents and for paths.

        ``true_means`` is as in `decompose`.
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

        ``true_means``: no pixel counts for more than another, even at the border of an odd side.
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

        It starts from what `reduced` gives, so that an image larger than memory can be decomposed
        in tiles.
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

        That is the image at 1 / 2^(count - shifts) of its sides. This is how a large image is
        decomposed in strips; the mean of a strip is a placeholder.
        """

    def rest(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Return the levels of `decompose` without its ``count`` - 1 finest.

        The plane of ``base`` is joined from those that `begin` gives for all strips.
        """

    def peaks(self, level_from_finest: int) -> tuple[tuple[float, float], ...]:
        """Return the best frequency of a level, in cycles/pixel, and the gain there.

        There is one pair for each orientation, or one for all of them.
        """


def mean_of(planes: Tensor) -> Tensor:
    """Return the mean (B, C, 1, 1) of (B, C, H, W), good to its last bit at any size.

    The lowpass term multiplies the difference of two means by 76 and more: the rounding of a sum
    over millions of pixels would be visible.
    """
    rows = planes.mean(-1, keepdim=True).to(widest(planes.device))
    return rows.mean(-2, keepdim=True).to(planes)
