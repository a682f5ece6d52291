"""CSF filtering, the sixth box of Fig. 2: how little contrast each channel needs."""

import torch
from torch import Tensor

# Barten 1989 (The square root integral), the constants of its approximation.
# a = PEAK (1 + 0.7/L)^-0.2 / (1 + 12 / (w (1 + u/3)^2)); b = 0.3 (1 + 100/L)^0.15; c = 0.06.
# Units: L in cd/m2, u in cycles/degree, w in degrees. Status: source.
PEAK = 540.0
PEAK_LUMINANCE, PEAK_EXPONENT = 0.7, 0.2
SIZE_TERM, SIZE_FREQUENCY = 12.0, 3.0
FALL, FALL_LUMINANCE, FALL_EXPONENT = 0.3, 100.0, 0.15
KNEE = 0.06

# The least distance from the peak in octaves, so that its root has a finite slope. Status: choice.
SMALLEST_OFFSET = 1e-12


def barten(frequency: Tensor, luminance: Tensor, size: Tensor) -> Tensor:
    """Return the achromatic contrast sensitivity of Barten 1989, S(u).

    S(u) = a u exp(-b u) sqrt(1 + c exp(b u)); sensitivity is one over threshold contrast.

    Parameters
    ----------
    frequency
        Spatial frequency u in cycles/degree, positive.
    luminance
        Adaptation luminance L in cd/m2, positive.
    size
        Side w of the target in degrees.
    """
    a = (
        PEAK
        * (1.0 + PEAK_LUMINANCE / luminance) ** -PEAK_EXPONENT
        / (1.0 + SIZE_TERM / (size * (1.0 + frequency / SIZE_FREQUENCY) ** 2))
    )
    b = FALL * (1.0 + FALL_LUMINANCE / luminance) ** FALL_EXPONENT
    # exp(-b u) sqrt(1 + c exp(b u)), written so that nothing overflows in the dark or at high u.
    falling = torch.exp(-0.5 * b * frequency)
    return a * frequency * falling * torch.sqrt(falling * falling + KNEE)


def bandpass(octaves: Tensor, width: Tensor, floor: Tensor) -> Tensor:
    """Return a sensitivity relative to its peak, between 0 and 1, ``octaves`` above the peak.

    Above the peak it is exp(-(octaves / width)^1.5). Below, the same curve falls only to ``floor``,
    because sensitivity levels off at low frequency. The exponent is a choice: an exponential is
    too pointed, a parabola falls too fast.
    """
    offset = octaves.abs().clamp_min(SMALLEST_OFFSET) / width
    falling = torch.exp(-offset * torch.sqrt(offset))
    return torch.where(octaves > 0.0, falling, floor + (1.0 - floor) * falling)


def butterworth(frequency: Tensor, gain: Tensor, cutoff: Tensor, order: Tensor) -> Tensor:
    """Return a chromatic contrast sensitivity, gain / sqrt(1 + (f / cutoff)^(2 order)).

    It is lowpass, like the chromatic sensitivities of Mullen 1985; ``frequency`` and ``cutoff``
    are in cycles/degree.
    """
    return gain / torch.sqrt(1.0 + (frequency / cutoff) ** (2.0 * order))
