"""The scalar chain, from light to JND, against 50 digits."""

import pytest

from benchmarks.exact import largest_error
from torch_vdm import Observer


@pytest.mark.parametrize("observer", [Observer.calibrated(), Observer.paper()])
def test_the_stages_lose_nothing(observer: Observer) -> None:
    # The smallest differences are those of nearly equal responses: 1 % apart, two digits are lost.
    assert largest_error(observer) < 1e-11
