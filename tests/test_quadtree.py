"""The quad-tree's moves against their definitions, written as loops."""

import pytest
import torch

from tests.reference import calibrated, paper
from torch_vdm.model import quadtree
from torch_vdm.model.grid import UNSHIFTED, Before, Grid, thirds
from torch_vdm.model.quadtree import pad_even, push

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (3, 5), (8, 8), (7, 12)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_odd_sides_repeat_their_last_row_and_column(height: int, width: int) -> None:
    plane = torch.rand(2, 3, height, width)
    even = pad_even(plane)
    assert even.shape == (2, 3, 2 * -(-height // 2), 2 * -(-width // 2))
    for y in range(even.shape[2]):
        for x in range(even.shape[3]):
            assert torch.equal(even[..., y, x], plane[..., min(y, height - 1), min(x, width - 1)])


each_before = pytest.mark.parametrize("before", [(0, 0), (0, 1), (1, 0), (1, 1)], ids=str)


def parents_of(batch: int, height: int, width: int, before: Before) -> torch.Tensor:
    rows, columns = (height + before[0] + 1) // 2, (width + before[1] + 1) // 2
    return torch.rand(batch, 3, rows, columns)


@each_before
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_push_gives_children_their_parent(height: int, width: int, before: Before) -> None:
    parents = parents_of(2, height, width, before)
    children = push(parents, (height, width), before=before)
    assert children.shape == (2, 3, height, width)
    for y in range(height):
        for x in range(width):
            parent = parents[..., (y + before[0]) // 2, (x + before[1]) // 2]
            assert torch.equal(children[..., y, x], parent)


@pytest.mark.parametrize("side", [*range(1, 70), 255, 256, 257, 1000, 1080, 1920, 4096, 2**24])
def test_thirds_begin_a_third_of_a_node_before_the_image(side: int) -> None:
    rows = calibrated.rows_of(side) if side < 2000 else []
    grid = thirds((side, 1))
    # The descent ends, one level later at most than on the paper's grid.
    assert 0 <= len(grid.rows) - paper.level_count(side, 1) <= 1
    nodes = side
    for octave, before in enumerate(grid.rows):
        assert nodes > 1
        begin, node = grid.offset(octave)[0], 2**octave
        if rows:
            assert (rows[octave].node, rows[octave].begin, rows[octave].nodes()) == (
                node,
                -begin,
                nodes,
            )
        if octave > UNSHIFTED and nodes > 2:  # within a node that is not shifted
            within = 2 * 2**UNSHIFTED
            assert min(abs(3 * begin - node), abs(3 * begin - 2 * node)) <= within
        if octave <= UNSHIFTED:
            assert begin == 0
        first, last = grid.sides((side, 1), octave)[0][1:]
        assert first * node == min(node, node - begin)
        assert (nodes - 2 + first + last) * node == side
        nodes = (nodes + before + 1) // 2
    assert nodes == 1
    assert grid.before(len(grid.rows)) == (0, 0)


def test_a_part_has_the_grid_of_the_image_where_it_begins_with_it() -> None:
    grid = thirds((200, 300))
    assert grid.part((0, 64), 3) == Grid(grid.rows[:3], ())
    assert grid.part((11, 0), 3) == Grid((), grid.columns[:3])
    assert grid.down(3) == (grid.before(3), grid.before(2), grid.before(1))
    assert grid.down(2, 3) == (grid.before(5), grid.before(4))
    assert Grid().offset(9) == (0, 0)


def test_even_planes_are_not_copied() -> None:
    plane = torch.rand(1, 3, 4, 6)
    assert pad_even(plane) is plane


@pytest.mark.parametrize("shape", [(2, 3, 4, 5), (1, 3, 3, 7, 1), (1, 1, 1, 1)], ids=str)
def test_both_ways_of_pushing_are_one(
    shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    nodes = torch.rand(shape, dtype=torch.float64)
    sizes = [(2 * shape[-2] - odd, 2 * shape[-1] - odd) for odd in (0, 1)]
    small = [push(nodes, size) for size in sizes]
    monkeypatch.setattr(quadtree, "SMALL", 0)
    for size, children in zip(sizes, small, strict=True):
        assert children.shape == (*shape[:-2], *size)
        assert torch.equal(children, push(nodes, size))
