"""Where the nodes of a quad-tree lie on an image: which pixels each covers.

The paper's nodes begin at the image's corner, so that an edge on a multiple of 2^k coincides with a
border of nodes at k levels, where no wavelet responds to it. Nodes may begin before the corner
instead: at some levels one node is put before the first row and column, just as an odd side gets
one after the last.
"""

from typing import NamedTuple

# How many nodes are put before the first at a level, in y and in x: 0 or 1. The parent of node i
# along a side is (i + before) // 2.
Before = tuple[int, int]

NONE: Before = (0, 0)

# How many octaves, from the pixels up, begin at the corner. If these were shifted too, the last
# row of pixels would be alone in a node and in its parent, and the eye would adapt to that row
# even if it is black. Status: choice.
UNSHIFTED = 2


class Side(NamedTuple):
    """How the nodes of a plane lie along one side of an image."""

    before: int
    """How many nodes are put before the first, 0 or 1."""
    first: float
    """The fraction of its pixels that the first node has."""
    last: float
    """The same for the last node. The only node of a side is both, and has all pixels there are."""


class Grid(NamedTuple):
    """How many nodes are put before the first, from the pixels up; none at coarser levels.

    The default is the paper's grid.
    """

    rows: tuple[int, ...] = ()
    """0 or 1 for each level."""
    columns: tuple[int, ...] = ()

    def before(self, octave: int) -> Before:
        """Return how many nodes are put before the first of those of 2^octave pixels."""
        rows, columns = (steps[octave : octave + 1] for steps in self)
        return sum(rows), sum(columns)

    def down(self, levels: int, finest: int = 0) -> tuple[Before, ...]:
        """Return the same for so many levels of nodes, the coarsest first.

        The finest of them has nodes of 2^(finest + 1) pixels.
        """
        return tuple(self.before(finest + levels - level) for level in range(levels))

    def offset(self, octave: int) -> tuple[int, int]:
        """Return how many pixels before the image the first node of 2^octave pixels begins."""
        rows, columns = (
            sum(step << finer for finer, step in enumerate(steps[:octave])) for steps in self
        )
        return rows, columns

    def sides(self, size: tuple[int, int], octave: int) -> tuple[Side, Side]:
        """Return how nodes of 2^octave pixels lie on an image of ``size`` = (H, W) pixels."""
        node = 2**octave
        rows, columns = (
            Side(before, (node - offset) / node, ((side + offset) % node or node) / node)
            for side, before, offset in zip(
                size, self.before(octave), self.offset(octave), strict=True
            )
        )
        return rows, columns

    def part(self, corner: tuple[int, int], octaves: int) -> "Grid":
        """Return the grid of a part of the image whose first pixel is ``corner``, y and x.

        It has the ``octaves`` finest levels. The part begins at the image's border, or where a node
        of the level above these begins, and so a node of each of them.
        """
        rows, columns = (
            steps[:octaves] if begin == 0 else () for steps, begin in zip(self, corner, strict=True)
        )
        return Grid(rows, columns)


# The first nodes of all levels begin with the image.
PAPERS = Grid()


def thirds(size: tuple[int, int]) -> Grid:
    """Return the grid whose nodes begin one or two thirds of a node before the image's corner.

    From `UNSHIFTED` on, one node is put before the first at every second level: the nodes of 2^k
    pixels then begin (...010100) pixels before the corner, a binary number of k digits. Where only
    two nodes are left, the children of the root, none is put before them.
    """
    rows, columns = map(_thirds, size)
    return Grid(rows, columns)


def _thirds(nodes: int) -> tuple[int, ...]:
    steps: list[int] = []
    while nodes > 1:
        octave = len(steps)
        step = 1 if octave >= UNSHIFTED and octave % 2 == 0 and nodes > 2 else 0
        steps.append(step)
        nodes = (nodes + step + 1) // 2
    return tuple(steps)
