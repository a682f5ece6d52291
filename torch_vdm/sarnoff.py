"""The Sarnoff visual discrimination model of Lubin 1995: what the paper's metric simplifies.

J. Lubin, A Visual Discrimination Model for Imaging System Design and Evaluation (in E. Peli, ed.,
Vision Models for Target Detection and Recognition, World Scientific 1995, pp. 245-283). The
chapter was not at hand: what is marked "recalled" is from memory, see docs/model.md.
"""

import math
from functools import partial
from typing import NoReturn

import torch
from torch import Tensor
from torch.nn import functional

from torch_vdm.model.cortex import oriented
from torch_vdm.model.cortex.gaussian import along, expand, lowpass_response, reduce, response
from torch_vdm.model.csf import barten
from torch_vdm.model.display import BT709_TO_XYZ, Display
from torch_vdm.model.distance import local_visual_difference
from torch_vdm.model.grid import Grid
from torch_vdm.model.masking import energy_transducer
from torch_vdm.options import switch
from torch_vdm.pair import Nonfinite, PairMetric
from torch_vdm.run.schedule import Schedule

# Line spread function of the eye, the sum of weight exp(-decay x^2) and weight exp(-decay abs(x)),
# x in minutes of arc. Source: Westheimer 1986. Status: source. Beyond RADIUS it is under 1/1000 of
# its peak. It is applied along rows and columns, which is exact for gratings along them. Status:
# choice.
GAUSSIAN_WEIGHT, GAUSSIAN_DECAY = 0.47, 3.3
EXPONENTIAL_WEIGHT, EXPONENTIAL_DECAY = 0.53, 0.93
RADIUS = 7.0

# Pixels per degree of the cone mosaic that images are resampled to. Status: recalled.
MOSAIC = 120.0

# Octaves of the pyramid. Status: recalled.
OCTAVES = 7

# Frequency of a band in cycles per sample: 32 cycles/degree for the finest on the mosaic. Status:
# recalled (32, 16 ... 0.5 cycles/degree).
BAND = 32.0 / 120.0

# The adaptation luminance in cd/m2 and the size of Barten's target in degrees, those of the paper's
# observer; and the eye's own light, which only keeps a division by 0 finite. Status: choice.
ADAPTATION, SIZE, DARK_LIGHT = 100.0, 12.0, 1e-4

# Contrasts are clamped to this: values that are not light have no bound. Status: choice.
LARGEST = 1e10

# Exponent of the distance summation. Status: recalled, and printed in Eq. 5 of the paper.
EXPONENT = 2.4

# Planes with more elements are filtered in bands of rows, which stay in the processor's cache.
# Status: choice, measured.
LARGEST_AT_ONCE = 2**17

# The gains of the oriented filters at a band's own frequency, so that the energy of a grating of
# that frequency does not depend on phase.
EVEN_GAIN, ODD_GAIN = oriented.even_gain(BAND), oriented.odd_gain(BAND)


class Sarnoff(PairMetric):
    """The Sarnoff visual discrimination model, for luminance.

    It is called like `VDM`: (B, 3, H, W) twice give the map of visible differences (B, 1, H, W) in
    just-noticeable differences.

    Parameters
    ----------
    ppd
        Pixels in one degree of the visual field, 1 to 1200.
    display
        What the pixel values are; `Display.srgb()` by default.
    resample
        Whether to resample to the cone mosaic, 120 pixels/degree, as Lubin does; time grows as
        (120 / ppd)^2. Off: the bands' frequencies follow the image's own pixels.
    nonfinite
        As in `VDM`.

    Raises
    ------
    ValueError
        If a parameter or an image is not as stated.
    """

    def __init__(
        self,
        ppd: float = 60.0,
        display: Display | None = None,
        resample: bool = True,
        nonfinite: Nonfinite = "raise",
    ) -> None:
        super().__init__(ppd, display, nonfinite)
        if not 1.0 <= self.ppd <= 1200.0:
            raise ValueError(
                f"expected pixels per degree between 1 and 1200 for Sarnoff's model, got {ppd}"
            )
        self.resample = switch("resample", resample)
        self._spread = _line_spread(self.ppd)
        self._set_constants(
            {
                "luminance": BT709_TO_XYZ[1:2],
                "sensitivities": self._sensitivities(),
                "summation_exponent": EXPONENT,
            }
        )

    @property
    def frequencies(self) -> list[float]:
        """The frequencies of the bands in cycles/degree, the finest first."""
        samples = MOSAIC if self.resample else self.ppd
        return [BAND * samples / 2.0**octave for octave in range(OCTAVES)]

    def extra_repr(self) -> str:
        """Return the options."""
        return f"ppd={self.ppd}, display={self.display}, resample={self.resample}"

    def tiled(self, *_: object, **__: object) -> NoReturn:
        """Refuse: see the message."""
        raise ValueError(
            "expected a VDM for an image in tiles, got Sarnoff's model, whose resampling to its "
            "own grid has no exact tiles; crop the image, or use VDM().tiled"
        )

    tiled_score = tiled

    def _sensitivities(self) -> list[float]:
        """Return the weight of every band, the finest first.

        With these, a grating of a band's frequency, at the threshold contrast of Barten's formula,
        has an energy of 1: a weight is his sensitivity over what the optics and the pyramid leave
        of the grating. Aliasing in the pyramid and blur by resampling are not counted.
        """
        # On the CPU, whatever the default device is: it is read back at once.
        exact = partial(torch.tensor, dtype=torch.float64, device="cpu")
        luminance, size = exact(ADAPTATION), exact(SIZE)
        weights = []
        for octave, frequency in enumerate(self.frequencies):
            cycles = min(frequency / self.ppd, 0.5)  # nothing is finer than a pixel
            passed = response(self._spread, cycles)
            for finer in range(octave):
                passed *= lowpass_response(BAND / 2.0 ** (octave - finer))
            passed *= 1.0 - lowpass_response(BAND) ** 2
            sensitivity = barten(exact(frequency), luminance, size)
            weights.append(float(sensitivity) / passed)
        return weights

    @property
    def _steps(self) -> Schedule:
        return Schedule(compiled=self._compiles and not torch.compiler.is_compiling())

    def _accumulated(self, test: Tensor, reference: Tensor) -> Tensor:
        sensitivities = self._constants(test.dtype, "sensitivities")["sensitivities"]
        first, second = self._pyramid(test), self._pyramid(reference)
        total: Tensor | None = None
        for octave in reversed(range(OCTAVES)):
            sensitivity = sensitivities[octave].clone()
            contrasts = [self._contrast(*planes[octave : octave + 3]) for planes in (first, second)]
            local = self._local_difference(contrasts[0], contrasts[1], sensitivity)
            if total is not None:
                size = (local.shape[-2], local.shape[-1])
                local = local + expand(total, size, self._steps)
            total = local
        assert total is not None
        return total

    def _local_difference(self, first: Tensor, second: Tensor, sensitivity: Tensor) -> Tensor:
        """Return the local visual difference (B, 1, h, w) of two contrast planes of a band."""
        exponent = self._constants(first.dtype, "summation_exponent")["summation_exponent"]
        steps = self._steps
        halo = oriented.REACH
        padded = [_surround(plane, halo) for plane in (first, second)]
        height = first.shape[-2]
        rows = steps.rows(height, first.numel(), LARGEST_AT_ONCE)
        parts = []
        for top in range(0, height, rows):
            end = min(top + rows, height) + 2 * halo
            one, other = (steps(oriented.across, plane[..., top:end, :]) for plane in padded)
            parts.append(steps(_response_difference, one, other, sensitivity))
        whole = torch.cat(parts, -2) if len(parts) > 1 else parts[0]
        local: Tensor = steps(_pooled_difference, whole, exponent)
        return local

    def _contrast(self, plane: Tensor, lower: Tensor, lowest: Tensor) -> Tensor:
        """Return the local contrast: a Laplacian band over the lowpass two levels down."""
        size = (plane.shape[-2], plane.shape[-1])
        around = expand(lowest, (lower.shape[-2], lower.shape[-1]), self._steps)
        around = expand(around, size, self._steps)
        lowpass = expand(lower, size, self._steps)
        contrast: Tensor = self._steps(_divided, plane, lowpass, around)
        return contrast

    def _pyramid(self, image: Tensor) -> list[Tensor]:
        """Return the lowpass planes of the luminance after the optics, the finest first."""
        matrix = self._constants(image.dtype, "luminance")["luminance"]
        plane = self._steps(_luminance, image, self.display, matrix)
        for blur in (_blurred_along_rows, _blurred_along_columns):
            plane = self._steps(blur, plane, self._spread)
        if self.resample:
            size = [max(1, round(side * MOSAIC / self.ppd)) for side in plane.shape[-2:]]
            plane = functional.interpolate(plane, size, mode="bicubic", antialias=True)
        planes = [plane]
        for _ in range(OCTAVES + 1):
            planes.append(reduce(planes[-1], self._steps))
        return planes

    def _to_pixels(
        self,
        plane: Tensor,
        size: tuple[int, int],
        grid: Grid | None = None,  # noqa: ARG002  # there are no parts
    ) -> Tensor:
        if not self.resample or plane.shape[-2:] == size:
            return plane
        # Linear, because the map must not fall below 0.
        return functional.interpolate(plane, size, mode="bilinear", antialias=True)


def _line_spread(ppd: float) -> tuple[float, ...]:
    """Return the weights of the eye's line spread function at the pixels, with a sum of 1."""
    reach = math.ceil(RADIUS * ppd / 60.0)
    minutes = [60.0 * tap / ppd for tap in range(-reach, reach + 1)]
    spread = [
        GAUSSIAN_WEIGHT * math.exp(-GAUSSIAN_DECAY * x * x)
        + EXPONENTIAL_WEIGHT * math.exp(-EXPONENTIAL_DECAY * abs(x))
        for x in minutes
    ]
    return tuple(weight / sum(spread) for weight in spread)


def _luminance(image: Tensor, display: Display, matrix: Tensor) -> Tensor:
    """Return the luminance (B, 1, H, W), cd/m2, of an image on a display."""
    light = display.to_xyz(image, matrix)
    return light[:, 1:2] if display.encoding == "xyz" else light


def _surround(plane: Tensor, width: int) -> Tensor:
    """Repeat the border of (B, C, h, w) ``width`` times on every side."""
    return functional.pad(plane, (width, width, width, width), mode="replicate")


def _blurred_along_rows(plane: Tensor, spread: tuple[float, ...]) -> Tensor:
    """Return a plane blurred by the eye's line spread, along its rows."""
    reach = len(spread) // 2
    return along(functional.pad(plane, (reach, reach, 0, 0), mode="replicate"), spread, -1)


def _blurred_along_columns(plane: Tensor, spread: tuple[float, ...]) -> Tensor:
    """Return a plane blurred by the eye's line spread, along its columns."""
    reach = len(spread) // 2
    return along(functional.pad(plane, (0, 0, reach, reach), mode="replicate"), spread, -2)


def _divided(plane: Tensor, lowpass: Tensor, around: Tensor) -> Tensor:
    """Return the band between a plane and its lowpass, over what the eye is adapted to."""
    adapted = around.clamp_min(0.0) + DARK_LIGHT
    return ((plane - lowpass) / adapted).clamp(-LARGEST, LARGEST)


def _energies(rows: tuple[Tensor, ...]) -> Tensor:
    """Return the energy of the quadrature pairs, (B, 4, h, w), from what `across` gives."""
    pairs = oriented.quadrature(rows, EVEN_GAIN, ODD_GAIN)
    return torch.cat([even * even + odd * odd for even, odd in pairs], 1)


def _response_difference(
    first: tuple[Tensor, ...], second: tuple[Tensor, ...], sensitivity: Tensor
) -> Tensor:
    """Return the difference of the transducer outputs of two images, (B, 4, h, w)."""
    weight = sensitivity * sensitivity
    one = energy_transducer(_energies(first) * weight)
    return one - energy_transducer(_energies(second) * weight)


def _pooled_difference(difference: Tensor, exponent: Tensor) -> Tensor:
    """Return the local visual difference; the difference is pooled, because pooling is linear.

    Pooling is the mean over a disc 5 wide, with its 21 samples of equal weight: choice.
    """
    padded = _surround(difference, 2)
    length = difference.shape[-2]
    inner = padded[..., 1:-3] + padded[..., 2:-2] + padded[..., 3:-1]
    outer = inner + padded[..., :-4] + padded[..., 4:]
    pooled = inner[..., :length, :] + inner[..., 4:, :]
    for row in range(1, 4):
        pooled = pooled + outer[..., row : row + length, :]
    return local_visual_difference((pooled / 21.0).unsqueeze(1), exponent)
