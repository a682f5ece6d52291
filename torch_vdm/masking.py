"""The masking transducer, the seventh box of Fig. 2: strong contrast hides contrast."""

import torch
from torch import Tensor

# Eq. 4 of Bolin and Meyer 1999, T(A) = 2 A^(2.25/2) / (A^(2.05/2) + 1). Status: printed.
GAIN, NUMERATOR, DENOMINATOR = 2.0, 2.25 / 2.0, 2.05 / 2.0

# Below this the output is 0 in float32. Status: choice.
SMALLEST_ENERGY = 1e-35


def energy_transducer(energy: Tensor) -> Tensor:
    """Return T(A) of Eq. 4; A is the energy (contrast x sensitivity)^2, T(1) = 1.

    The sign of a detail is lost in the energy, and the slope at 0 is 0.
    """
    # Powers as the energy times what is left of it, in the processor's own base 2, as in
    # `local_visual_difference`: one logarithm for both.
    octaves = torch.log2(energy.clamp_min(SMALLEST_ENERGY))
    numerator = energy * torch.exp2((NUMERATOR - 1.0) * octaves)
    return GAIN * numerator / (energy * torch.exp2((DENOMINATOR - 1.0) * octaves) + 1.0)


def signed_transducer(contrast: Tensor, exponent: Tensor, energy: Tensor | None = None) -> Tensor:
    """Return 2^q v / (1 + E)^q for a weighted contrast v (1 at threshold); psi(1) = 1 alone.

    ``energy`` E is what masks, v^2 by default; see `masking_energy`.

    Odd, so that a detail differs from its negative; its slope at 0 is 2^q, so that a loss moves
    from grey or black; far out it grows as v^(1 - 2q), so that with q = 0.3 a strong contrast hides
    increments in proportion to its power 0.6 (Legge and Foley 1980). Status: choice.
    """
    # Base 2 because a processor's own exponential is: (1 + E)^-q = 2^(-q log2(1 + E)).
    energy = contrast * contrast if energy is None else energy
    return contrast * torch.exp2(exponent * (1.0 - torch.log2(energy + 1.0)))


def masking_energy(contrast: Tensor) -> Tensor:
    """Return what masks a weighted contrast, (B, C, 1, h, w): all orientations at its place.

    ``contrast`` is (B, channels, orientations, h, w), even and odd ones of a pair among them. A
    grating hides one at right angles to it as much as people say (Foley 1994, within 0.5 dB over
    the threshold without a mask); the same direction alone would hide 12 dB less. Status: choice,
    measured.
    """
    return (contrast * contrast).sum(2, keepdim=True)
