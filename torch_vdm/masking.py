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


def signed_transducer(
    contrast: Tensor, exponent: Tensor, start: Tensor, knee: Tensor, phases: int = 1
) -> Tensor:
    """Return c v (s + v^2) / (k + v^2)^(1 + q) for a weighted contrast v, psi(1) = 1.

    ``contrast`` is (B, channels, orientations, h, w), 1 at threshold; q is ``exponent``, s is
    ``start``, k is ``knee``. Of ``phases`` successive orientations, the even and odd ones of a
    pair, v^2 is the energy of all: what they mask has no phase.

    Odd, so that a detail differs from its negative. It rises as v, then v^3, then v^(1 - 2q): a
    weak pedestal makes a contrast easier to see, a strong one harder (Legge and Foley 1980). Its
    slope at 0 is not 0, so that a loss moves from grey or black.
    """
    energy = contrast * contrast
    if phases > 1:
        energy = energy.unflatten(2, (-1, phases)).sum(3, keepdim=True)
        contrast = contrast.unflatten(2, (-1, phases))
    # Base 2 because a processor's own exponential is. The quotient is bounded where v^3 is not.
    above = energy + knee
    falling = torch.exp2(exponent * (torch.log2(knee + 1.0) - torch.log2(above)))
    gain = (energy + start) / above * falling * ((knee + 1.0) / (start + 1.0))
    response: Tensor = contrast * gain
    return response.flatten(2, 3) if phases > 1 else response
