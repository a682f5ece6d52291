"""The trees of error against plain loops, and against the metric's own accumulation."""

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sampling.error import maximum, total
from torch_vdm import VDM, Display, Observer

SIZES = [(1, 1), (1, 2), (4, 4), (5, 3), (8, 13)]
Planes = list[NDArray[np.float64]]


def make_levels(height: int, width: int, seed: int) -> Planes:
    rng = np.random.default_rng(seed)
    levels: Planes = []
    while True:
        levels.append(rng.uniform(0.0, 1.0, (height, width)))
        if max(height, width) == 1:
            return levels[::-1]
        height, width = (height + 1) // 2, (width + 1) // 2


def loop_maximum(levels: Planes, level: int, y: int, x: int) -> float:
    """Return a node's local error plus the largest maximum of its children, by recursion."""
    own = float(levels[level][y, x])
    if level == len(levels) - 1:
        return own
    height, width = levels[level + 1].shape
    below = [
        loop_maximum(levels, level + 1, v, u)
        for v in range(2 * y, min(2 * y + 2, height))
        for u in range(2 * x, min(2 * x + 2, width))
    ]
    return own + max(below)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_maximum_and_total_match_loops(height: int, width: int) -> None:
    levels = make_levels(height, width, 7)
    local = [torch.from_numpy(plane)[None, None] for plane in levels]
    largest = maximum(local)
    found = total(local, largest)
    for level, plane in enumerate(levels):
        for y in range(plane.shape[0]):
            for x in range(plane.shape[1]):
                expected = loop_maximum(levels, level, y, x)
                assert float(largest[level][0, 0, y, x]) == pytest.approx(expected, rel=1e-12)
                for above in range(level):
                    shift = level - above
                    expected += levels[above][y >> shift, x >> shift]
                assert float(found[level][0, 0, y, x]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_every_level_has_the_same_largest_total(height: int, width: int) -> None:
    local = [torch.from_numpy(plane)[None, None] for plane in make_levels(height, width, 8)]
    largest = [float(nodes.max()) for nodes in total(local, maximum(local))]
    assert largest == pytest.approx([float(maximum(local)[0])] * len(local), rel=1e-12)


@pytest.mark.parametrize(
    "observer", [Observer.paper(), Observer.calibrated()], ids=lambda o: o.name
)
def test_the_finest_totals_are_the_metrics_own_map(observer: Observer) -> None:
    metric = VDM(60.0, Display.linear(), observer)
    generator = torch.Generator().manual_seed(4)
    first, second = (
        metric.represent(torch.rand(1, 3, 13, 6, generator=generator, dtype=torch.float64))
        for _ in range(2)
    )
    second = second._replace(mean=first.mean)  # no lowpass term
    local = metric.local_differences(first, second)
    torch.testing.assert_close(total(local, maximum(local))[-1], metric.compare(first, second))
