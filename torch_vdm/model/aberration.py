"""Chromatic aberration, the third box of Fig. 2: short wavelengths reach the retina blurred."""

import torch
from torch import Tensor


def attenuation(frequency: Tensor, cutoff: Tensor, exponent: Tensor) -> Tensor:
    """Return the fraction of contrast that the eye's optics pass, for the S, M and L cones.

    For S it is exp(-(f / cutoff)^exponent), between 0 and 1: the ratio of the modulation transfer
    of the S cones to that of luminance (Section 2, after Marimont and Wandell 1993). For M and L
    it is 1.
    ``frequency`` (levels,) and ``cutoff`` are in cycles/degree; the result is (levels, 3).
    """
    short = torch.exp(-((frequency / cutoff) ** exponent))
    return torch.stack((short, torch.ones_like(short), torch.ones_like(short)), -1)
