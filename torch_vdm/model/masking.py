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
    # Each power is the energy times the remaining power, in the processor's native base 2, as in
    # `local_visual_difference`: one logarithm serves both.
    octaves = torch.log2(energy.clamp_min(SMALLEST_ENERGY))
    numerator = energy * torch.exp2((NUMERATOR - 1.0) * octaves)
    return GAIN * numerator / (energy * torch.exp2((DENOMINATOR - 1.0) * octaves) + 1.0)


def unmasked(masks: Tensor, exponent: Tensor) -> Tensor:
    """Return what masking leaves of a squared signed difference, log2 of (2 / (1 + E))^(2q).

    A contrast v against none, pooled alone, is left as the square of 2^q v / (1 + v^2)^q. This is 1
    at threshold and nowhere else, has a slope at 0 so that a loss can leave grey or black, and
    goes as v^(1 - 2q) far above threshold. On a pedestal the increment threshold rises with the
    pedestal to the power of 2q, 0.6 for q = 0.3 (Legge and Foley 1980). Status: choice.

    Parameters
    ----------
    masks
        (B, channels, 1, h, w): E, the `masking_energy` of weighted contrast, 1 at threshold, pooled
        like the difference. A small spot is then spread as widely as what masks it: masked by its
        own centre, it would be seen 10 dB worse than people see it.
    exponent
        q.
    """
    # A logarithm in the processor's native base, as `local_visual_difference_of_energy` takes it.
    return 2.0 * exponent * (1.0 - torch.log2(masks + 1.0))


def masking_energy(first: Tensor, second: Tensor) -> Tensor:
    """Return what masks the difference of two weighted contrasts: the energy of both.

    It is (B, channels, 1, h, w) from (B, channels, orientations, h, w), which includes the even and
    odd phases of quadrature pairs. A grating masks one at right angles to it (Foley 1994); the same
    direction alone would mask 12 dB less. Status: choice, measured.
    """
    return (first * first).sum(2, keepdim=True) + (second * second).sum(2, keepdim=True)
