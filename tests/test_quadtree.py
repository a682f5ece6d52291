"""The quad-tree's moves against their definitions, written as loops."""

import pytest
import torch

from torch_vdm import quadtree
from torch_vdm.quadtree import apart, pad_even, push, stacked

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (3, 5), (8, 8), (7, 12)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_odd_sides_repeat_their_last_row_and_column(height: int, width: int) -> None:
    plane = torch.rand(2, 3, height, width)
    even = pad_even(plane)
    assert even.shape == (2, 3, 2 * -(-height // 2), 2 * -(-width // 2))
    for y in range(even.shape[2]):
        for x in range(even.shape[3]):
            assert torch.equal(even[..., y, x], plane[..., min(y, height - 1), min(x, width - 1)])


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_push_gives_children_their_parent(height: int, width: int) -> None:
    parents = torch.rand(2, 3, -(-height // 2), -(-width // 2))
    children = push(parents, (height, width))
    assert children.shape == (2, 3, height, width)
    for y in range(height):
        for x in range(width):
            assert torch.equal(children[..., y, x], parents[..., y // 2, x // 2])


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_trees_below_one_another_are_pushed_each_by_itself(height: int, width: int) -> None:
    parents = torch.rand(3, 2, -(-height // 2), -(-width // 2))
    children = push(stacked(parents), (3 * height, width), 3)
    assert torch.equal(children, stacked(push(parents, (height, width))))
    assert torch.equal(apart(children[0], 3).transpose(0, 1), push(parents, (height, width)))


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
