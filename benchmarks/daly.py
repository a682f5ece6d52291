"""Daly's visible differences predictor of 1993, a comparator: a map of detection probability.

S. Daly, The Visible Differences Predictor: An Algorithm for the Assessment of Image Fidelity (in A.
B. Watson, ed., Digital Images and Human Vision, MIT Press 1993, pp. 179-206). The chapter was not
at hand: constants marked "source" are those of public implementations, "recalled" ones are from
memory. His amplitude nonlinearity is left out (choice): it would scale every contrast, and what
makes up for that in his calibration is not known here.
"""

import itertools
import math

import torch
from torch import Tensor

from torch_vdm.model.display import BT709_TO_XYZ, Display

# Contrast sensitivity: peak, eccentricity, size and orientation terms. Status: source.
PEAK, EPSILON = 250.0, 0.9
AMPLITUDE, AMPLITUDE_LUMINANCE, AMPLITUDE_EXPONENT = 0.801, 0.7, -0.2
FALL, FALL_LUMINANCE, FALL_EXPONENT = 0.3, 100.0, 0.15
SIZE, SIZE_EXPONENT, SIZE_POWER = 3.23, -0.3, 5.0
ACCOMMODATION, ACCOMMODATION_EXPONENT = 0.856, 0.14
OBLIQUE = 0.78
KNEE = 0.06

# The cortex transform: octaves with the base, orientations, width of a transition. Status:
# recalled.
OCTAVES, ORIENTATIONS, TRANSITION = 6, 6, 2.0 / 3.0

# Threshold elevation (1 + (K1 (K2 m)^s)^b)^(1/b): W = 6, Q = 0.7; s by octave from the base up.
# Status: source.
K1, K2, SHARPNESS = 0.0153, 392.498, 4.0
SLOPES = (0.7, 0.8, 0.8, 1.0, 1.0, 1.0)

# Slope of the psychometric function. Status: source.
PSYCHOMETRIC = 3.5

# The eye's own light, cd/m2, which only keeps a division by 0 finite. Status: choice.
DARK_LIGHT = 1e-4


def detection_probability(
    test: Tensor,
    reference: Tensor,
    ppd: float = 60.0,
    display: Display | None = None,
    distance: float = 0.5,
) -> Tensor:
    """Return the probability that the difference is seen, at every pixel.

    Parameters
    ----------
    test, reference
        (B, 3, H, W), floating point, as the display expects them.
    ppd
        Pixels in one degree of the visual field.
    display
        What the pixel values are; `Display.srgb()` by default.
    distance
        From the eye to the screen in metres, for its accommodation.

    Returns
    -------
    Tensor
        (B, 1, H, W), 0 to 1, float64.
    """
    display = display or Display.srgb()
    contrasts = []
    for image in (test, reference):
        matrix = torch.tensor(BT709_TO_XYZ, dtype=torch.float64, device=image.device)
        luminance = display.to_xyz(image.double(), matrix)[:, 1:2].clamp_min(0.0) + DARK_LIGHT
        mean = luminance.mean((2, 3), keepdim=True)
        contrasts.append((luminance, mean))
    height, width = test.shape[-2:]
    # Mirrored once, so that the border is no edge of a picture that repeats itself.
    size = 2 * height, 2 * width
    y, x = torch.meshgrid(
        torch.fft.fftfreq(size[0], dtype=torch.float64, device=test.device),
        torch.fft.rfftfreq(size[1], dtype=torch.float64, device=test.device),
        indexing="ij",
    )
    filters = cortex_filters(x, y)
    degrees = height * width / ppd**2
    spectra = []
    for luminance, mean in contrasts:
        mirrored = torch.cat((luminance, luminance.flip(-1)), -1)
        mirrored = torch.cat((mirrored, mirrored.flip(-2)), -2)
        weight = sensitivity(ppd * x, ppd * y, mean, degrees, distance)
        spectra.append(torch.fft.rfft2(mirrored / mean - 1.0) * weight)
    unseen = torch.ones_like(test[:, :1], dtype=torch.float64)
    for octave, bands in enumerate(filters):
        for band in bands:
            one, other = (
                torch.fft.irfft2(spectrum * band, s=size)[..., :height, :width]
                for spectrum in spectra
            )
            raised = torch.minimum(elevation(one, octave), elevation(other, octave))
            unseen = unseen * torch.exp(-(((one - other).abs() / raised) ** PSYCHOMETRIC))
    return 1.0 - unseen


def sensitivity(x: Tensor, y: Tensor, luminance: Tensor, size: float, distance: float) -> Tensor:
    """Return Daly's contrast sensitivity.

    ``x`` and ``y`` are frequencies in cycles/degree, ``luminance`` cd/m2, ``size`` square degrees,
    ``distance`` metres.
    """
    frequency = torch.hypot(x, y)
    # Cosine of four times the angle, 1 along rows and columns.
    turn = torch.cos(4.0 * torch.atan2(y, x))
    oblique = 0.5 * (1.0 - OBLIQUE) * turn + 0.5 * (1.0 + OBLIQUE)
    scale = ACCOMMODATION * distance**ACCOMMODATION_EXPONENT * oblique
    return PEAK * torch.minimum(
        _sensitivity(frequency / scale, luminance, size), _sensitivity(frequency, luminance, size)
    )


def _sensitivity(frequency: Tensor, luminance: Tensor, size: float) -> Tensor:
    amplitude = AMPLITUDE * (1.0 + AMPLITUDE_LUMINANCE / luminance) ** AMPLITUDE_EXPONENT
    fall = EPSILON * FALL * (1.0 + FALL_LUMINANCE / luminance) ** FALL_EXPONENT
    cycles = frequency.clamp_min(1e-6)
    area = (SIZE * (cycles * cycles * size) ** SIZE_EXPONENT) ** SIZE_POWER
    falling = torch.exp(-0.5 * fall * cycles)
    curve = EPSILON * cycles * falling * torch.sqrt(falling * falling + KNEE)
    return amplitude * curve * (area + 1.0) ** (-1.0 / SIZE_POWER)


def cortex_filters(x: Tensor, y: Tensor) -> list[list[Tensor]]:
    """Return Watson's cortex transform as Daly has it: filters by octave, the base first.

    ``x`` and ``y`` are cycles/pixel. The base has one filter and each other octave six of 30
    degrees; all of them sum to 1.
    """
    frequency = torch.hypot(x, y)
    half = 2.0**-OCTAVES
    reach = half + 0.5 * TRANSITION * half
    base = torch.exp(-0.5 * (frequency / (reach / 3.0)) ** 2)
    base = torch.where(frequency < reach, base, 0.0)
    bounds = [torch.ones_like(frequency)]
    bounds += [_mesa(frequency, 2.0**-octave) for octave in range(1, OCTAVES - 1)]
    bounds.append(base)
    octaves = [outer - inner for outer, inner in itertools.pairwise(bounds)]
    angle = torch.atan2(y, x)
    fans = []
    for orientation in range(ORIENTATIONS):
        away = torch.remainder(angle - orientation * math.pi / ORIENTATIONS, math.pi)
        away = torch.minimum(away, math.pi - away) * (ORIENTATIONS / math.pi)
        fans.append(torch.where(away < 1.0, 0.5 * (1.0 + torch.cos(math.pi * away)), 0.0))
    return [[base], *[[octave * fan for fan in fans] for octave in reversed(octaves)]]


def _mesa(frequency: Tensor, half: float) -> Tensor:
    """Return a lowpass that is 1/2 at ``half``, with a transition of a Hann window."""
    width = TRANSITION * half
    place = ((frequency - half) / width + 0.5).clamp(0.0, 1.0)
    return 0.5 * (1.0 + torch.cos(math.pi * place))


def elevation(contrast: Tensor, octave: int) -> Tensor:
    """Return how far a band's own weighted contrast raises its threshold, 1 and more."""
    mask = K1 * (K2 * contrast.abs()) ** SLOPES[octave]
    # As 1 + something: a mask of nearly 0 raises nothing.
    return torch.as_tensor((1.0 + mask**SHARPNESS) ** (1.0 / SHARPNESS))
