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


def signed_transducer(contrast: Tensor, exponent: Tensor, phases: int = 1) -> Tensor:
    """Return 2^q v / (1 + v^2)^q for a weighted contrast v (1 at threshold), psi(1) = 1.

    ``contrast`` is (B, channels, orientations, h, w). Of ``phases`` successive orientations, the
    even and odd ones of a pair, v^2 is the energy of all: what they mask has no phase.

    Odd, so that a detail differs from its negative; its slope at 0 is 2^q, so that a loss moves
    from grey or black; far out it grows as v^(1 - 2q), so that with q = 0.3 a strong contrast hides
    increments in proportion to its power 0.6 (Legge and Foley 1980). Status: choice.
    """
    # Base 2 because a processor's own exponential is: (1 + v^2)^-q = 2^(-q log2(1 + v^2)).
    energy = contrast * contrast
    if phases == 1:
        return contrast * torch.exp2(exponent * (1.0 - torch.log2(energy + 1.0)))
    energy = energy.unflatten(2, (-1, phases)).sum(3, keepdim=True)
    gain = torch.exp2(exponent * (1.0 - torch.log2(energy + 1.0)))
    response: Tensor = (contrast.unflatten(2, (-1, phases)) * gain).flatten(2, 3)
    return response
