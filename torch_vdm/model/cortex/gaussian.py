"""The Gaussian pyramid of Burt and Adelson 1983, along rows and columns.

P. J. Burt and E. H. Adelson, The Laplacian Pyramid as a Compact Image Code (IEEE Transactions on
Communications 31, 1983). Filters are additions of slices: faster here than a convolution, and in
full precision under autocast and TF32. Rows and columns are separate steps: otherwise compiled code
would filter the rows again for each tap of a column.
"""

import math
from collections.abc import Sequence

from torch import Tensor
from torch.nn import functional

from torch_vdm.model.interleave import interleaved
from torch_vdm.model.steps import PLAIN, Steps

# Weights of the lowpass, with a sum of 1; a = 3/8. Status: source.
CENTRE, NEXT, OUTER = 6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0


def along(plane: Tensor, weights: Sequence[float], dim: int, step: int = 1) -> Tensor:
    """Correlate with even or odd weights along ``dim``, -1 or -2, at every ``step``-th place.

    Their number n is odd; ``dim`` becomes n - 1 shorter. Taps of equal magnitude are added or
    subtracted before they are weighted.
    """
    last = len(weights) - 1
    centre = last // 2
    reach = plane.shape[dim] - last

    def shifted(tap: int) -> Tensor:
        places = slice(tap, tap + reach, step)
        return plane[..., places] if dim == -1 else plane[..., places, :]

    even = weights[0] == weights[last]
    total = shifted(centre) * weights[centre] if even else None
    for tap in range(centre):
        one, other = shifted(last - tap), shifted(tap)
        pair = one + other if even else one - other
        weight = weights[last - tap]
        total = pair * weight if total is None else total.add_(pair, alpha=weight)
    assert total is not None
    return total


def response(weights: Sequence[float], frequency: float) -> float:
    """Return the gain of even or odd weights for a grating of ``frequency`` cycles/sample."""
    centre = len(weights) // 2
    phases = [2.0 * math.pi * frequency * (tap - centre) for tap in range(len(weights))]
    even = sum(weight * math.cos(phase) for weight, phase in zip(weights, phases, strict=True))
    odd = sum(weight * math.sin(phase) for weight, phase in zip(weights, phases, strict=True))
    return math.hypot(even, odd)


def lowpass_response(frequency: float) -> float:
    """Return the gain of one reduction for a grating of ``frequency`` cycles/sample."""
    return response((OUTER, NEXT, CENTRE, NEXT, OUTER), frequency)


def blur(plane: Tensor, steps: Steps = PLAIN) -> Tensor:
    """Return the lowpass of a plane at every one of its samples."""
    rows: Tensor = steps(_blurred_rows, plane)
    columns: Tensor = steps(_blurred_columns, rows)
    return columns


def reduce(plane: Tensor, steps: Steps = PLAIN) -> Tensor:
    """Return the next coarser plane: every second sample, ceil(h / 2) x ceil(w / 2) of them."""
    rows: Tensor = steps(_reduced_rows, plane)
    columns: Tensor = steps(_reduced_columns, rows)
    return columns


def expand(plane: Tensor, size: tuple[int, int], steps: Steps = PLAIN) -> Tensor:
    """Return a plane at the ``size`` of the next finer one, interpolated smoothly."""
    rows: Tensor = steps(_expanded_rows, plane, size[1])
    columns: Tensor = steps(_expanded_columns, rows, size[0])
    return columns


def _blurred_rows(plane: Tensor) -> Tensor:
    padded = functional.pad(plane, (2, 2, 0, 0), mode="replicate")
    return along(padded, (OUTER, NEXT, CENTRE, NEXT, OUTER), -1)


def _blurred_columns(plane: Tensor) -> Tensor:
    padded = functional.pad(plane, (0, 0, 2, 2), mode="replicate")
    return along(padded, (OUTER, NEXT, CENTRE, NEXT, OUTER), -2)


def _reduced_rows(plane: Tensor) -> Tensor:
    padded, width = functional.pad(plane, (2, 2, 0, 0), mode="replicate"), plane.shape[-1]
    taps = [padded[..., tap : tap + width : 2] for tap in range(5)]
    return CENTRE * taps[2] + NEXT * (taps[1] + taps[3]) + OUTER * (taps[0] + taps[4])


def _reduced_columns(plane: Tensor) -> Tensor:
    padded, height = functional.pad(plane, (0, 0, 2, 2), mode="replicate"), plane.shape[-2]
    taps = [padded[..., tap : tap + height : 2, :] for tap in range(5)]
    return CENTRE * taps[2] + NEXT * (taps[1] + taps[3]) + OUTER * (taps[0] + taps[4])


def _expanded_rows(plane: Tensor, width: int) -> Tensor:
    padded = functional.pad(plane, (1, 1, 0, 0), mode="replicate")
    left, here, right = padded[..., :-2], padded[..., 1:-1], padded[..., 2:]
    even = 2.0 * CENTRE * here + 2.0 * OUTER * (left + right)
    return interleaved(even, 2.0 * NEXT * (here + right), -1)[..., :width]


def _expanded_columns(plane: Tensor, height: int) -> Tensor:
    padded = functional.pad(plane, (0, 0, 1, 1), mode="replicate")
    up, here, down = padded[..., :-2, :], padded[..., 1:-1, :], padded[..., 2:, :]
    even = 2.0 * CENTRE * here + 2.0 * OUTER * (up + down)
    return interleaved(even, 2.0 * NEXT * (here + down), -2)[..., :height, :]
