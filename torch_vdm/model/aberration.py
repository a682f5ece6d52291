"""Chromatic aberration, the third box of Fig. 2: short wavelengths reach the retina blurred."""

import torch
from torch import Tensor


def attenuation(frequency: Tensor, cutoff: Tensor, exponent: Tensor) -> Tensor:
    """Return the share of each cone's contrast, S, M, L, that the eye's optics let through.

    exp(-(f / cutoff)^exponent) for S, between 0 and 1: the ratio of the S cones' to the luminance
    modulation transfer (Section 2, after Marimont and Wandell 1993); 1 for M and L.
    ``frequency`` (levels,) and ``cutoff`` are in cycles/degree; the result is (levels, 3).
    """
    short = torch.exp(-((frequency / cutoff) ** exponent))
    return torch.stack((short, torch.ones_like(short), torch.ones_like(short)), -1)
