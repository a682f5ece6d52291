"""Spatial pooling, the eighth box of Fig. 2: neighbouring detectors add up."""

from torch import Tensor
from torch.nn import functional


def pool(responses: Tensor) -> Tensor:
    """Return the mean of every node's 3x3 neighbourhood, the border repeated.

    ``responses`` is (B, channels, orientations, h, w). The paper prints the size of the filter
    (against Sarnoff's 5x5) but not its weights: equal ones are a choice; a box of 3 nodes spans
    2.2 cycles of its level, near the 2.5 of Wilson 1991.
    """
    padded = functional.pad(responses.flatten(1, 2), (1, 1, 1, 1), mode="replicate")
    rows = padded[..., :-2, :] + padded[..., 1:-1, :] + padded[..., 2:, :]
    pooled = (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 9.0
    return pooled.view(responses.shape)
