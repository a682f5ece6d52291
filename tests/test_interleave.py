"""Samples in turn, against NumPy's own assignment to every second place."""

import numpy as np
import pytest
import torch

from torch_vdm.model.interleave import interleaved


@pytest.mark.parametrize("dim", [-1, -2])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.int64, torch.bool])
def test_samples_alternate_bit_for_bit(dtype: torch.dtype, dim: int) -> None:
    even = torch.tensor([[[0.0, -0.0, 3.0], [1e30, 1e-42, 7.0]]]).to(dtype)
    odd = torch.tensor([[[-1.0, 5.0, 0.0], [2.0, -1e-42, -0.0]]]).to(dtype)
    if dtype.is_floating_point:
        even[0, 0, 0], odd[0, 0, 0] = torch.inf, torch.nan
    shape = (1, 4, 3) if dim == -2 else (1, 2, 6)
    expected = np.zeros(shape, even.numpy().dtype)
    for first, plane in enumerate((even, odd)):
        places = slice(first, None, 2)
        expected[(..., places, slice(None)) if dim == -2 else (..., places)] = plane.numpy()
    assert interleaved(even, odd, dim).numpy().tobytes() == expected.tobytes()
