"""Eq. 5 and the sums down the tree against the reference."""

import numpy as np
import pytest
import torch

from tests.reference import paper
from torch_vdm.model.charging import Charge
from torch_vdm.model.distance import (
    accumulate,
    just_noticeable,
    local_visual_difference,
    local_visual_difference_of_energy,
)
from torch_vdm.model.quadtree import push

EXPONENT = torch.tensor(2.4, dtype=torch.float64)


def test_eq_5_is_the_reference() -> None:
    difference = np.random.default_rng(1).normal(size=(3, 3, 5, 6))
    expected = paper.local_visual_difference(difference)
    actual = local_visual_difference(torch.from_numpy(difference)[None], EXPONENT)
    np.testing.assert_allclose(actual[0, 0].numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("exponent", [2.4, 6.0])
def test_of_energies_it_is_that_of_their_roots(exponent: float) -> None:
    # What is left of an energy is told in octaves: here a quarter.
    energy = np.random.default_rng(3).uniform(size=(3, 3, 5, 6))
    energy[0, 0, :2] = 0.0
    expected = paper.local_visual_difference(np.sqrt(energy / 4.0), exponent)
    actual = local_visual_difference_of_energy(
        torch.from_numpy(energy)[None], torch.tensor(exponent, dtype=torch.float64), -2.0
    )
    np.testing.assert_allclose(actual[0, 0].numpy(), expected, rtol=1e-12)


@pytest.mark.parametrize("size", [(2, 2), (1, 5), (9, 6), (16, 16)])
def test_sums_down_the_paths_are_the_references(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(2)
    sizes = [size]
    while max(sizes[0]) > 1:
        sizes.insert(0, (-(-sizes[0][0] // 2), -(-sizes[0][1] // 2)))
    local = tuple(rng.uniform(size=nodes) for nodes in sizes[:-1])
    expected = paper.sum_down_paths(local, *size)
    zero = torch.zeros(1, 1, 1, 1, dtype=torch.float64)
    actual = push(accumulate([torch.from_numpy(nodes)[None, None] for nodes in local], zero), size)
    np.testing.assert_allclose(actual[0, 0].numpy(), expected, rtol=1e-12)


def test_the_root_term_reaches_every_leaf() -> None:
    local = [torch.zeros(1, 1, 1, 2), torch.zeros(1, 1, 2, 4)]
    assert (accumulate(local, torch.full((1, 1, 1, 1), 3.0)) == 3.0).all()


def test_a_node_has_the_shares_that_it_is_charged() -> None:
    root = torch.full((1, 1, 1, 1), 3.0)
    coarse, fine = torch.full((1, 1, 1, 1), 5.0), torch.tensor([[[[7.0, 11.0]]]])
    half, none, all_of_it = torch.tensor(0.5), torch.tensor(0.0), torch.tensor(1.0)
    inherited = torch.tensor([[[[0.25, 0.0]]]])
    charges = [Charge(half, None), Charge(inherited, none)]
    expected = torch.tensor([[[[0.25 * 6.5, 0.0]]]])
    assert torch.equal(accumulate([coarse, fine], root, charges=charges), expected)
    charges = [Charge(all_of_it, None), Charge(all_of_it, all_of_it)]
    plain = accumulate([coarse, fine], root)
    assert torch.equal(accumulate([coarse, fine], root, charges=charges), plain)


def test_the_root_undoes_the_power_and_has_a_finite_slope_at_zero() -> None:
    jnd = torch.tensor([0.0, 1e-6, 1.0, 30.0], dtype=torch.float64, requires_grad=True)
    back = just_noticeable(jnd**EXPONENT, EXPONENT)
    torch.testing.assert_close(back, jnd)
    (gradient,) = torch.autograd.grad(back.sum(), jnd)
    torch.testing.assert_close(gradient, torch.tensor([0.0, 1.0, 1.0, 1.0], dtype=torch.float64))
