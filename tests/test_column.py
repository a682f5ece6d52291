"""Levels in one column, and as cells of one plane: against the quad-tree's own moves."""

import pytest
import torch

from torch_vdm import Haar
from torch_vdm.model.cortex.border import weights
from torch_vdm.model.grid import Side
from torch_vdm.model.quadtree import push, surround
from torch_vdm.run.column import cells_of, column_of, joined

SIZES = [(1, 1), (1, 9), (2, 129), (40, 1), (24, 17), (33, 64)]


@pytest.mark.parametrize("true_means", [False, True])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_node_gets_what_is_pushed_to_it(size: tuple[int, int], true_means: bool) -> None:
    cortex = Haar().decompose(torch.rand(2, 3, *size), true_means=true_means)
    planes = cortex.lowpass
    sizes = tuple((plane.shape[-2], plane.shape[-1]) for plane in planes)
    column = column_of(sizes, cortex.before or [(0, 0)], planes[0])
    nodes = joined(planes)
    for back, plane in zip(column.planes(nodes), planes, strict=True):
        assert torch.equal(back, plane)
    above = column.planes(column.of_parents(nodes))
    for number, (plane, before) in enumerate(zip(above, cortex.before, strict=False)):
        parents = planes[max(number - 1, 0)]
        assert torch.equal(plane, push(parents, sizes[number], before))
    levels = column.planes(column.level[:, None])
    assert [set(level.flatten().tolist()) for level in levels] == [{n} for n in range(len(sizes))]


def test_what_is_kept_is_not_transformed() -> None:
    # Otherwise a later call would get what belongs to a transformation that has ended.
    sizes = ((1, 1), (1, 2), (2, 3))
    found: list[torch.Tensor] = []

    def total(plane: torch.Tensor) -> torch.Tensor:
        column = column_of(sizes, [(0, 0)] * 3, torch.zeros(1))
        found.extend((column.level, column.parent, *cells_of(sizes, (1, 1), torch.zeros(1))))
        down, across = weights((Side(1, 0.5, 1.0),) * 2, (11, 13), torch.zeros(1))
        found.extend((*down, *across))
        return plane.sum()

    torch.func.grad(total)(torch.ones(2, 3))
    assert len(found) == 8
    assert not any(map(torch._C._functorch.is_functorch_wrapped_tensor, found))


@pytest.mark.parametrize("ring", [(0, 0), (1, 1), (3, 2)], ids=str)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_cell_is_a_level_with_its_border_repeated(
    size: tuple[int, int], ring: tuple[int, int]
) -> None:
    planes = Haar().decompose(torch.rand(2, 3, *size)).lowpass
    sizes = tuple((plane.shape[-2], plane.shape[-1]) for plane in planes)
    column, cells = (
        column_of(sizes, [(0, 0)] * len(sizes), planes[0]),
        cells_of(sizes, ring, planes[0]),
    )
    plane = cells.of(joined(planes))
    before, after = ring
    inside = plane[..., before : plane.shape[-2] - after, before : plane.shape[-1] - after]
    # A plane without rings begins at the same place as the ring of a level with them.
    for level, places in zip(planes, column.planes(cells.places), strict=True):
        y, x = divmod(int(places[0, 0]), inside.shape[-1])
        height, width = (side + before + after for side in level.shape[-2:])
        assert torch.equal(plane[..., y : y + height, x : x + width], surround(level, *ring))
    assert torch.equal(cells.column(inside), joined(planes))
