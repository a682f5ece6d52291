"""Local errors for other numbers of samples: tiles that no change touches are not computed again.

A decision asks for the errors of one image many times, and each time only the variances differ:
the details and the adapting light stay the same. So a node's local error depends only on the
variances of its details and, by pooling, of its neighbours' details. Where these are unchanged, so
is the error, bit for bit.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from sampling.boundary import QUARTILE, boundaries, detail_variances
from torch_vdm import VDM
from torch_vdm.model.cortex import Cortex
from torch_vdm.model.grid import Before

# Levels of at most so many nodes are computed whole: there an operation's overhead outweighs its
# arithmetic. Status: choice, as in `torch_vdm.vdm`.
FEW_NODES = 64 * 64

# Nodes around a piece of a level that are computed with it: one for pooling, and one more because
# a piece begins where a parent does.
HALO = 2

# Nodes along the side of a tile; 32 with the halo. Status: choice.
TILE = 28

# With its halo a strip has multiples of so many rows and columns. Vectorised loops take up to 32
# values at a time and the remainder one by one, where 2^x has other last bits. These sides, and a
# tile's, leave no remainder, in nodes and in their parents. Status: measured, AVX-512.
ROWS, COLUMNS = 16, 8

# Largest width of a strip, in nodes. Status: choice.
WIDEST = 508

# Values of the pieces that are computed at once. More would take another path through the metric,
# with other last bits. Status: choice, as in `torch_vdm.vdm`.
AT_ONCE = 2**18

# Untouched tiles are skipped where the touched ones are at most this share of a level; otherwise
# the whole level is computed, in strips. Status: measured, `python -m benchmarks tiles`.
PAYS = 0.6

# Row and column of a piece among the pieces of a level.
Place = tuple[int, int]


class _Cut(NamedTuple):
    """How a level is cut into pieces."""

    rows: int
    """Rows of nodes in a piece, without the halo; even, as columns are."""
    columns: int
    down: int
    """How many pieces there are from top to bottom."""
    across: int

    def places(self) -> list[Place]:
        """Return the places of all pieces."""
        return [(y, x) for y in range(self.down) for x in range(self.across)]

    @property
    def nodes(self) -> int:
        """The number of nodes in a piece with its halo."""
        return (self.rows + 2 * HALO) * (self.columns + 2 * HALO)

    def around(self, plane: Tensor, places: Sequence[Place], node: int) -> Tensor:
        """Return pieces with their halo, one below the other, (..., h, w).

        ``plane`` has a halo, and each of its nodes spans ``node`` nodes of the level per side.
        """
        rows, columns, halo = self.rows // node, self.columns // node, 2 * HALO // node
        parts = [
            plane[..., y * rows : (y + 1) * rows + halo, x * columns : (x + 1) * columns + halo]
            for y, x in places
        ]
        return torch.cat(parts, -2)


class _Level:
    """A fine level of an image with fixed details, cut into tiles, or as a whole into strips."""

    def __init__(self, details: Tensor, parents: Tensor, finest: int, before: Before) -> None:
        self.before = before
        # With the padding before the first node: all pieces begin where a parent does.
        height, width = details.shape[-2] + before[0], details.shape[-1] + before[1]
        self.size = height, width
        self.finest = finest
        self.tiles = _Cut(TILE, TILE, -(-height // TILE), -(-width // TILE))
        columns = _side(width, WIDEST, COLUMNS)
        rows = _side(height, AT_ONCE // (9 * (columns + 2 * HALO)) - 2 * HALO, ROWS)
        self.strips = _Cut(rows, columns, -(-height // rows), -(-width // columns))
        down = max(cut.rows * cut.down for cut in (self.tiles, self.strips)) - height
        right = max(cut.columns * cut.across for cut in (self.tiles, self.strips)) - width
        self._sides = (HALO + before[1], HALO + right, HALO + before[0], HALO + down)
        self.details = self.padded(details)
        # On an odd side the last parent has one node; the padding before the first has its parent.
        left, right, top, down = (side // 2 for side in self._sides)
        self.parents = functional.pad(parents, (left, right, top, down), mode="replicate")

    def padded(self, plane: Tensor) -> Tensor:
        """Return a plane (1, C, n, h, w) with its border replicated to cover all pieces."""
        return functional.pad(plane, (*self._sides, 0, 0), mode="replicate")


class LocalErrors:
    """The local errors of the boundary images of one image, for any variances.

    They are in single precision, except the mean of the image, which is known far better than a
    pixel.

    Parameters
    ----------
    metric
        The metric that judges.
    truth
        The image, with the details that it is taken to have; (1, C, ...), with one plane of a grey
        image for three.
    leaves
        (1, C, H, W), float32: the variances of the pixels with which others are compared.

    Attributes
    ----------
    own
        What `at` returns for ``leaves``.
    """

    def __init__(self, metric: VDM, truth: Cortex, leaves: Tensor) -> None:
        self._metric = metric
        nodes = [detail.shape[-2] * detail.shape[-1] for detail in truth.details]
        few = sum(count <= FEW_NODES for count in nodes)
        details = [detail.float() for detail in truth.details]
        # The light to which the eye is adapted.
        windows = [plane.float() for plane in truth.windows or truth.lowpass]
        self._coarse = Cortex(
            tuple(details[:few]),
            tuple(windows[: max(few, 1)]),
            truth.mean,
            len(nodes) - few,
            grid=truth.grid,
        )
        self._levels = [
            _Level(
                details[number],
                windows[number - 1],
                len(nodes) - 1 - number,
                truth.before[number],
            )
            for number in range(few, len(nodes))
        ]
        variances = detail_variances(leaves, metric.observer.true_means)
        self._variances = variances[few:]
        self._kept = [
            self._computed(level, variance)
            for level, variance in zip(self._levels, self._variances, strict=True)
        ]
        self.own: tuple[Tensor, ...] = (
            *local_errors(metric, self._coarse, variances[:few], leaves),
            *(
                kept[..., level.before[0] :, level.before[1] :]
                for level, kept in zip(self._levels, self._kept, strict=True)
            ),
        )

    def at(self, leaves: Tensor, pays: float = PAYS) -> tuple[Tensor, ...]:
        """Return the local errors, as `local_errors`, for these variances of pixels, (1, C, H, W).

        Untouched tiles are skipped where touched ones are at most the share ``pays`` of a level,
        which changes no bit.
        """
        variances = detail_variances(leaves, self._metric.observer.true_means)
        few = len(self._coarse.details)
        local = [*local_errors(self._metric, self._coarse, variances[:few], leaves)]
        for level, variance, before, kept in zip(
            self._levels, variances[few:], self._variances, self._kept, strict=True
        ):
            touched = _touched(variance, before, level)
            skip = len(touched) <= pays * level.tiles.down * level.tiles.across
            again = (kept, touched) if skip else ()
            top, left = level.before
            local.append(self._computed(level, variance, *again)[..., top:, left:])
        return tuple(local)

    def touched(self, leaves: Tensor) -> float:
        """Return the share of tiles that these variances touch, over all levels with tiles."""
        variances = detail_variances(leaves, self._metric.observer.true_means)
        fine = variances[len(self._coarse.details) :]
        found = [
            len(_touched(variance, before, level))
            for level, variance, before in zip(self._levels, fine, self._variances, strict=True)
        ]
        return sum(found) / max(sum(len(level.tiles.places()) for level in self._levels), 1)

    def _computed(
        self,
        level: _Level,
        variance: Tensor,
        kept: Tensor | None = None,
        tiles: Sequence[Place] = (),
    ) -> Tensor:
        """Return the local errors of a level: those in ``kept``, except in ``tiles``.

        The shape is (1, 1, h, w), with the padding before the first nodes.
        """
        if kept is None:
            local, cut = variance.new_empty(1, 1, *level.size), level.strips
            tiles = cut.places()
        else:
            local, cut = kept.clone(), level.tiles
        whole = level.padded(variance)
        nothing = variance.new_zeros(1, variance.shape[1], 1, 1)
        together = max(AT_ONCE // (9 * cut.nodes), 1)
        for first in range(0, len(tiles), together):
            places = tiles[first : first + together]
            # The coarsest level of a part of an image takes the parents that it is given.
            part = Cortex(
                (cut.around(level.details, places, 1),),
                (cut.around(level.parents, places, 2),),
                nothing,
                level.finest,
            )
            lower, upper = boundaries(
                part,
                (cut.around(whole, places, 1),),
                nothing,
                QUARTILE,
                self._metric.observer.signed,
            )
            (errors,) = self._metric.local_differences(lower, upper)
            inside = slice(HALO, -HALO), slice(HALO, -HALO)
            for (y, x), found in zip(places, errors.chunk(len(places), -2), strict=True):
                top, left = y * cut.rows, x * cut.columns
                here = local[..., top : top + cut.rows, left : left + cut.columns]
                here.copy_(found[..., *inside][..., : here.shape[-2], : here.shape[-1]])
        return local


def local_errors(
    metric: VDM, truth: Cortex, variances: tuple[Tensor, ...], leaves: Tensor
) -> tuple[Tensor, ...]:
    """Return the local errors of the two boundary images of an image.

    Parameters
    ----------
    metric
        The metric that judges.
    truth
        The image, with the details that it is taken to have.
    variances
        Variances of its details.
    leaves
        (1, C, H, W), variances of its pixels.

    Returns
    -------
    tuple of Tensor
        One (1, 1, h, w) per level, level 0 first, in JND to the power of the summation exponent.
        The lowpass term is in level 0, which an image of one pixel has too.
    """
    mean = leaves.mean((-2, -1), keepdim=True, dtype=torch.float64)
    of_mean = mean / leaves[0, 0].numel()
    lower, upper = boundaries(truth, variances, of_mean, QUARTILE, metric.observer.signed)
    root = metric.lowpass_difference(lower, upper) ** metric.observer.summation_exponent
    root = root.sum(1, keepdim=True)
    first, *others = metric.local_differences(lower, upper) or (torch.zeros_like(root),)
    return (first + root.to(first), *others)


def _touched(variance: Tensor, before: Tensor, level: _Level) -> list[Place]:
    """Return the tiles in which a variance (1, C, n, h, w), or a neighbour's, differs."""
    differs = (variance != before).flatten(1, 2).any(1, keepdim=True).to(torch.float32)
    (height, width), (top, left), tiles = level.size, level.before, level.tiles
    sides = (left + 1, tiles.across * TILE - width + 1, top + 1, tiles.down * TILE - height + 1)
    found = functional.max_pool2d(functional.pad(differs, sides), TILE + 2, TILE)[0, 0]
    return [(int(y), int(x)) for y, x in found.nonzero().tolist()]


def _side(nodes: int, most: int, multiple: int) -> int:
    """Return the side of the fewest equal pieces that cover the nodes; with halo a ``multiple``."""
    most = (most + 2 * HALO) // multiple * multiple - 2 * HALO
    each = -(-nodes // -(-nodes // most))
    return -(-(each + 2 * HALO) // multiple) * multiple - 2 * HALO
