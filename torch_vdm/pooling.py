"""Spatial pooling, the eighth box of Fig. 2: neighbouring detectors add up."""

from torch import Tensor
from torch.nn import functional


def surround(responses: Tensor) -> Tensor:
    """Repeat the border of (B, channels, orientations, h, w) once on every side."""
    padded = functional.pad(responses.flatten(1, 2), (1, 1, 1, 1), mode="replicate")
    return padded.view(*responses.shape[:3], *padded.shape[2:])


def pool(surrounded: Tensor) -> Tensor:
    """Return the mean of every node's 3x3 neighbourhood.

    From (B, channels, orientations, h + 2, w + 2), made by `surround`, to (..., h, w). The paper
    prints the size of the filter (against Sarnoff's 5x5) but not its weights: equal ones are a
    choice; a box of 3 nodes spans 2.2 cycles of its level, near the 2.5 of Wilson 1991.
    """
    rows = surrounded[..., :-2, :] + surrounded[..., 1:-1, :] + surrounded[..., 2:, :]
    return (rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]) / 9.0
