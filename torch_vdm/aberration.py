"""Chromatic aberration, the third box of Fig. 2: short wavelengths reach the retina blurred."""

import torch
from torch import Tensor


def short_wave_attenuation(frequency: Tensor, cutoff: Tensor, exponent: Tensor) -> Tensor:
    """Return the share of the S cones' contrast that the eye's optics let through.

    exp(-(f / cutoff)^exponent), between 0 and 1: the ratio of the S cones' to the luminance
    modulation transfer (Section 2, after Marimont and Wandell 1993). ``frequency`` and
    ``cutoff`` are in cycles/degree.
    """
    return torch.exp(-((frequency / cutoff) ** exponent))


def attenuate_short_wave(details: Tensor, attenuation: Tensor) -> Tensor:
    """Scale the S cones' details (B, 3, orientations, h, w) by a 0-dim ``attenuation``."""
    one = torch.ones_like(attenuation)
    return details * torch.stack((attenuation, one, one)).view(3, 1, 1, 1)
