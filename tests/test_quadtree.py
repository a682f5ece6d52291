"""The quad-tree's moves against their definitions, written as loops."""

import math

import pytest
import torch

from torch_vdm.quadtree import depth, pad_even, pull, push

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2), (3, 5), (8, 8), (7, 12)]


@pytest.mark.parametrize("sides", [(1, 1), (1, 2), (3, 2), (4, 4), (5, 1), (1080, 1920)])
def test_depth_is_the_ceiling_of_the_logarithm(sides: tuple[int, int]) -> None:
    assert depth(*sides) == math.ceil(math.log2(max(sides)))


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_pull_takes_the_mean_of_four_children(height: int, width: int) -> None:
    plane = torch.rand(2, 3, height, width, dtype=torch.float64)
    parents = pull(plane)
    assert parents.shape == (2, 3, -(-height // 2), -(-width // 2))
    for y in range(parents.shape[2]):
        for x in range(parents.shape[3]):
            rows = [min(2 * y + step, height - 1) for step in (0, 1)]
            columns = [min(2 * x + step, width - 1) for step in (0, 1)]
            children = plane[:, :, rows][..., columns]
            torch.testing.assert_close(parents[..., y, x], children.mean((2, 3)))


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_push_gives_children_their_parent(height: int, width: int) -> None:
    parents = torch.rand(2, 3, -(-height // 2), -(-width // 2))
    children = push(parents, (height, width))
    assert children.shape == (2, 3, height, width)
    for y in range(height):
        for x in range(width):
            assert torch.equal(children[..., y, x], parents[..., y // 2, x // 2])


def test_pull_undoes_push() -> None:
    parents = torch.rand(1, 3, 5, 4)
    assert torch.equal(pull(push(parents, (10, 8))), parents)


def test_even_planes_are_not_copied() -> None:
    plane = torch.rand(1, 3, 4, 6)
    assert pad_even(plane) is plane
