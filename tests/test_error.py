"""The trees of error against plain loops, and against the metric's own accumulation."""

import itertools

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from sampling.error import maximum, total
from torch_vdm import VDM, Display, Haar, Observer
from torch_vdm.model.grid import Grid

SIZES = [(1, 1), (1, 2), (4, 4), (5, 3), (8, 13)]
Planes = list[NDArray[np.float64]]


each_grid = pytest.mark.parametrize("true_means", [False, True], ids=["paper", "thirds"])


def made(height: int, width: int, seed: int, true_means: bool) -> tuple[Planes, Grid]:
    """Return numbers for the nodes of every level, the root first, and where these lie."""
    rng = np.random.default_rng(seed)
    # The finest nodes are 2 pixels wide; here they are the leaves.
    grid = Haar().grid((2 * height, 2 * width), true_means)
    down, across = grid.before(0)
    height, width = height + down, width + across
    levels: Planes = []
    for octave in itertools.count(1):
        levels.append(rng.uniform(0.0, 1.0, (height, width)))
        if max(height, width) == 1:
            break
        down, across = grid.before(octave)
        height, width = (height + down + 1) // 2, (width + across + 1) // 2
    return levels[::-1], grid


def parent(levels: Planes, grid: Grid, level: int, y: int, x: int) -> tuple[int, int]:
    down, across = grid.before(len(levels) - level)
    return (y + down) // 2, (x + across) // 2


def loop_maximum(levels: Planes, grid: Grid, level: int, y: int, x: int) -> float:
    """Return a node's local error plus the largest maximum of its children, by recursion."""
    own = float(levels[level][y, x])
    if level == len(levels) - 1:
        return own
    height, width = levels[level + 1].shape
    below = [
        loop_maximum(levels, grid, level + 1, v, u)
        for v, u in np.ndindex(height, width)
        if parent(levels, grid, level + 1, v, u) == (y, x)
    ]
    return own + max(below)


@each_grid
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_maximum_and_total_match_loops(height: int, width: int, true_means: bool) -> None:
    levels, grid = made(height, width, 7, true_means)
    local = [torch.from_numpy(plane)[None, None] for plane in levels]
    largest = maximum(local, grid)
    found = total(local, largest, grid)
    for level, plane in enumerate(levels):
        for y, x in np.ndindex(plane.shape):
            expected = loop_maximum(levels, grid, level, y, x)
            assert float(largest[level][0, 0, y, x]) == pytest.approx(expected, rel=1e-12)
            v, u = y, x
            for below in range(level, 0, -1):
                v, u = parent(levels, grid, below, v, u)
                expected += levels[below - 1][v, u]
            assert float(found[level][0, 0, y, x]) == pytest.approx(expected, rel=1e-12)


@each_grid
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_every_level_has_the_same_largest_total(height: int, width: int, true_means: bool) -> None:
    levels, grid = made(height, width, 8, true_means)
    local = [torch.from_numpy(plane)[None, None] for plane in levels]
    largest = maximum(local, grid)
    most = [float(nodes.max()) for nodes in total(local, largest, grid)]
    assert most == pytest.approx([float(largest[0])] * len(local), rel=1e-12)


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
    grid = first.grid
    finest = total(local, maximum(local, grid), grid)[-1]
    # Charged to all pixels below a node, as printed.
    torch.testing.assert_close(finest, metric.beside(first)(second))
