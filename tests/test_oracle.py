"""What `benchmarks.oracle` finds where it is known how much placement can save."""

import numpy as np
import pytest
import torch

from benchmarks.oracle import Oracle
from sampling.renderers.synthetic import Synthetic
from sampling.statistics import Statistics
from torch_vdm import VDM, Display


def oracle(noisy: int, side: int = 16) -> Oracle:
    """Return that of a grey wall, whose first columns alone have any noise."""
    event = np.zeros((side, side, 3))
    event[:, :noisy] = 0.4
    renderer = Synthetic(np.full((side, side, 3), 0.2), event, np.full((side, side), 0.5))
    pixels = np.arange(side * side)
    statistics = Statistics(side * side)
    statistics.add(renderer.sample(pixels, 0 * pixels, 0 * pixels + 1024))
    return Oracle(VDM(60.0, Display.linear(100.0)), statistics, renderer.size)


def test_samples_where_there_is_no_noise_are_saved_and_no_others() -> None:
    half = oracle(8)
    even = half.needed(torch.ones(16, 16), 1.0)
    least = half.least(1.0, even, 40)
    # The half that has noise is as even as can be, but for its borders.
    assert 0.4 < least / even < 0.6


def test_noise_needs_samples_by_its_variance() -> None:
    whole = oracle(16)
    even = whole.needed(torch.ones(16, 16), 1.0)
    whole.root *= 2.0
    assert whole.needed(torch.ones(16, 16), 1.0) == pytest.approx(4.0 * even, rel=0.03)
    # In whatever unit the shape comes.
    shape = torch.full((16, 16), 7.0)
    assert whole.needed(shape, 1.0) == whole.needed(torch.ones(16, 16), 1.0)
