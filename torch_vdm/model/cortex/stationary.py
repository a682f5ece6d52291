"""The Haar decomposition with shifts: nodes overlap, so that no place and no phase is preferred."""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.cortex.haar import (
    EXPONENT,
    Haar,
    lowpasses,
    wavelet_response,
    window_response,
)
from torch_vdm.model.cortex.transform import CSF, Base, Cortex, checked_csf, mean_of
from torch_vdm.model.grid import PAPERS, Grid, Side
from torch_vdm.model.interleave import interleaved
from torch_vdm.model.steps import PLAIN, Steps


@dataclass(frozen=True)
class StationaryHaar:
    """The Haar wavelets at four shifts per node, with four times the coefficients of `Haar`.

    Nodes lie half a node apart in x and in y. With these shifts alone, all nodes would sample a
    grating of one cycle per node at its peaks, or all at its zeros. So every second row and column
    of nodes is shifted by a quarter more, and any 2x2 neighbours lie at four different quarters of
    a node both in x and in y. The finest level, whose nodes are 2 pixels wide, has no quarters.

    The paper's plane d3 is tuned to diagonal gratings; its frequency and gain are those for these.

    Parameters
    ----------
    csf
        As in `Haar`.

    Raises
    ------
    ValueError
        As in `Haar`.
    """

    csf: CSF = "levels"

    shifts = 2
    phases = 1
    reach = 5

    def __post_init__(self) -> None:
        """Refuse an unknown option."""
        checked_csf(self.csf)

    def grid(self, size: tuple[int, int], true_means: bool) -> Grid:  # noqa: ARG002
        """Return where the nodes lie on an image: the first begin with it."""
        return PAPERS

    def decompose(
        self,
        planes: Tensor,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,  # noqa: ARG002  # as `grid`
    ) -> Cortex:
        """Decompose (B, C, H, W) to the coarsest level; arguments as in `Haar.decompose`.

        Returns
        -------
        Cortex
            ``details[l]`` is (B, C, 3, h, w) as in `Haar`, but the finest has the image's own size
            and each coarser one half its sides, rounded up. On level k from the finest, the node
            (y, x) begins at the pixel (2^k y, 2^k x), or 2^(k - 1) after it.
        """
        size = (planes.shape[-2], planes.shape[-1])
        mean = steps.once(mean_of, planes)
        means = lowpasses(planes, 0, size, true_means)
        # The means of nodes of 1, 1, 2, 4 ... pixels: halves of the finest, quarters of all others.
        parts = [planes, planes, *means][: len(means)]
        if not parts:
            return Cortex((), (planes,), mean)
        return self._cortex(parts, 0, size, mean, steps, true_means)

    def begin(
        self,
        planes: Tensor,
        count: int,
        steps: Steps = PLAIN,
        true_means: bool = False,
        *,
        grid: Grid | None = None,  # noqa: ARG002  # as `grid`
    ) -> tuple[Cortex, Tensor]:
        """Return the finest levels, and what `rest` continues from; see `Transform.begin`."""
        size = (planes.shape[-2], planes.shape[-1])
        means = lowpasses(planes, 0, size, true_means, count - 2)
        parts = [planes, planes, *means]
        none = planes[..., :1, :1]
        return self._cortex(parts, 0, size, none, steps, true_means), means[-1]

    def rest(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Return the coarser levels; see `Transform.rest`."""
        return self.resume(base, steps, true_means)

    def reduced(
        self,
        planes: Tensor,
        octaves: int,
        steps: Steps = PLAIN,  # noqa: ARG002  # as in `decompose`
        true_means: bool = False,
        *,
        grid: Grid | None = None,  # noqa: ARG002  # as `grid`
    ) -> Tensor:
        """Return the means of nodes of 2^octaves pixels; arguments as in `decompose`."""
        size = (planes.shape[-2], planes.shape[-1])
        return [planes, *lowpasses(planes, 0, size, true_means, octaves)][octaves]

    def resume(self, base: Base, steps: Steps = PLAIN, true_means: bool = False) -> Cortex:
        """Decompose the rest of an image; see `Transform.resume`."""
        means = lowpasses(base.plane, base.octaves, base.size, true_means)
        parts = [base.plane, *means][: len(means) - 1]
        return self._cortex(parts, base.octaves + 1, base.size, base.mean, steps, true_means)

    def peaks(self, level_from_finest: int) -> tuple[tuple[float, float], ...]:
        """Return the best frequency, cycles/pixel, and its gain for d1, d2 and d3.

        For a filtered image they are those of `Haar`.
        """
        if self.csf == "filter":
            return Haar("filter").peaks(level_from_finest)
        return _peaks(level_from_finest)

    def _cortex(
        self,
        parts: list[Tensor],
        finest: int,
        size: tuple[int, int],
        mean: Tensor,
        steps: Steps,
        true_means: bool,
    ) -> Cortex:
        """Return the levels from ``finest`` on, from the means of the parts of their nodes."""
        details: list[Tensor] = []
        lowpass: list[Tensor] = []
        # Behind a filter, what the eye is adapted to is no longer needed.
        means = self.csf == "levels"
        for level, part in enumerate(parts, finest):
            faded = _faded(part, PAPERS.sides(size, max(level - 1, 0))) if true_means else part
            analyse = _halves if level == 0 else _quarters
            detail, *lowest = steps(analyse, faded, means)
            details.append(detail)
            lowpass += lowest
        # A node may begin before its parent, where that is shifted. If it were inside, the parent
        # would have at least a quarter of its light.
        windows = [
            torch.maximum(parent, 0.25 * functional.max_pool2d(nodes, 2, ceil_mode=True))
            for nodes, parent in itertools.pairwise(lowpass)
        ]
        found = details, lowpass, lowpass[:1] + windows
        details_of, lowpass_of, windows_of = (tuple(reversed(planes)) for planes in found)
        return Cortex(details_of, lowpass_of, mean, finest, windows=windows_of or None)


def _faded(parts: Tensor, sides: tuple[Side, Side]) -> Tensor:
    """Weaken a last row or column that has only a fraction r of its pixels.

    R becomes L + 2 r / (1 + r) (R - L), where L is its neighbour, so that (L + R) / 2 is the mean
    of the real pixels of both.
    """
    for side, axis in zip(sides, (-2, -1), strict=True):
        count, real = parts.shape[axis], side.last
        if count == 1 or real == 1.0:
            continue
        before, last = parts.narrow(axis, count - 2, 1), parts.narrow(axis, count - 1, 1)
        last = before + 2.0 * real / (1.0 + real) * (last - before)
        parts = torch.cat((parts.narrow(axis, 0, count - 1), last), axis)
    return parts


def _combined(
    sums: tuple[Tensor, Tensor], differences: tuple[Tensor, Tensor], means: bool
) -> list[Tensor]:
    """Return details and, with ``means``, lowpass, Eq. 2, of the four quarters of nodes.

    ``sums`` and ``differences`` of left and right are those of a fourth of each, above and below.
    """
    details = (differences[0] + differences[1], sums[0] - sums[1], differences[0] - differences[1])
    return [torch.stack(details, 2), *([sums[0] + sums[1]] if means else [])]


def _halves(parts: Tensor, means: bool) -> list[Tensor]:
    """Return what `_combined` does for nodes of 2 x 2 parts that begin at every part."""
    padded = functional.pad(0.25 * parts, (0, 1, 0, 1), mode="replicate")
    left, right = padded[..., :-1], padded[..., 1:]
    # Every row is the upper one of a node and the lower one of another.
    sums, differences = (
        (rows[..., :-1, :], rows[..., 1:, :]) for rows in (left + right, left - right)
    )
    return _combined(sums, differences, means)


def _quarters(parts: Tensor, means: bool) -> list[Tensor]:
    """Return the same for nodes of 4 x 4 parts that begin at every second part or the one after.

    A block of 2 x 2 nodes begins at (0, 0), (1, 3), (2, 1) and (3, 2), where half a node is 2.
    """
    height, width = ((side + 1) // 2 for side in parts.shape[-2:])
    rows, columns = (height + 1) // 2, (width + 1) // 2
    more = 4 * columns + 3 - parts.shape[-1], 4 * rows + 3 - parts.shape[-2]
    padded = functional.pad(parts, (0, more[0], 0, more[1]), mode="replicate")
    halves = padded[..., :-1, :] + padded[..., 1:, :]
    halves = (0.25 * 0.25) * (halves[..., :-1] + halves[..., 1:])

    def nodes(top: int, left: int) -> list[Tensor]:
        def corner(y: int, x: int) -> Tensor:
            y, x = top + y, left + x
            return halves[..., y : y + 4 * rows - 3 : 4, x : x + 4 * columns - 3 : 4]

        pairs = [(corner(y, 0), corner(y, 2)) for y in (0, 2)]
        sums, differences = zip(*((one + two, one - two) for one, two in pairs), strict=True)
        return _combined(sums, differences, means)

    four = nodes(0, 0), nodes(1, 3), nodes(2, 1), nodes(3, 2)
    return [_two_by_two(*planes)[..., :height, :width] for planes in zip(*four, strict=True)]


def _two_by_two(one: Tensor, right: Tensor, below: Tensor, across: Tensor) -> Tensor:
    """Return (..., 2 h, 2 w) with each of four planes at one place of every 2x2."""
    return interleaved(interleaved(one, right, -1), interleaved(below, across, -1), -2)


@lru_cache
def _peaks(level_from_finest: int) -> tuple[tuple[float, float], ...]:
    """Return what `StationaryHaar.peaks` does.

    d1 and d2 are tuned to gratings along their own axis, and there to what `Haar.peak` gives. d3 is
    the wavelet in both directions, so its best grating is a diagonal one of sqrt(2) times the
    frequency. Its gain makes a diagonal grating of the frequency f of d1 and d2 as strong as a
    vertical one in the sum over all three with EXPONENT: 2 (W L / g)^4 + (W^2 / gain)^4 = 1, where
    W and L are the gains of the wavelet and the window at f / sqrt(2), and g is that at f.
    """
    frequency, gain = Haar().peak(level_from_finest)
    half = 2**level_from_finest
    along = frequency / math.sqrt(2.0)
    wavelet, window = wavelet_response(half, along), window_response(half, along)
    others = 2.0 * (wavelet * window / gain) ** EXPONENT
    diagonal = wavelet**2 / (1.0 - others) ** (1.0 / EXPONENT)
    return (frequency, gain), (frequency, gain), (math.sqrt(2.0) * frequency, diagonal)
