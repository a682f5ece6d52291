"""From pixel values to light: what the screen shows, and how large a pixel looks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Self, get_args

import torch
from torch import Tensor

from torch_vdm.model.limit import within
from torch_vdm.model.matrix import mix
from torch_vdm.options import choice, number

Encoding = Literal["srgb", "linear", "xyz"]

# Linear BT.709 to CIE XYZ, D65 white of Y = 1. Source: IEC 61966-2-1:1999. Status: source.
BT709_TO_XYZ = (
    (0.4124, 0.3576, 0.1805),
    (0.2126, 0.7152, 0.0722),
    (0.0193, 0.1192, 0.9505),
)
# The sRGB transfer of IEC 61966-2-1: slope and end of the linear part, offset, exponent.
SRGB_SLOPE, SRGB_KNEE, SRGB_OFFSET, SRGB_EXPONENT = 12.92, 0.04045, 0.055, 2.4

# Where the linear part ends, in light. Source: the same.
SRGB_TOE = 0.0031308

# What `Display.to_code` takes as white where the image is absolute XYZ, in cd/m2. Status: choice.
XYZ_WHITE = 100.0

# Light is clamped to this, in cd/m2: the sun's disc has about 1.6e9 cd/m2, and the sum of four
# pixels must stay finite in float32. Status: choice.
BRIGHTEST = 1e12
# The same for sRGB-coded values, whose nominal range is [0, 1]. Status: choice.
LARGEST_CODE = 1e4


@dataclass(frozen=True)
class Display:
    """How an image of pixel values becomes light; use `srgb`, `linear` or `xyz`.

    Attributes
    ----------
    encoding
        What the three channels are.
    white
        Luminance of the pixel value (1, 1, 1), in cd/m2; 1 for XYZ, which is absolute.
    exposure
        In stops; the light is multiplied by 2^exposure.
    """

    encoding: Encoding
    white: float
    exposure: float = 0.0

    def __post_init__(self) -> None:
        """Refuse invalid options."""
        choice("an encoding", self.encoding, get_args(Encoding))
        for name in ("white", "exposure"):
            object.__setattr__(self, name, number(name, getattr(self, name)))
        if self.encoding == "xyz" and (self.white, self.exposure) != (1.0, 0.0):
            raise ValueError(
                "expected a white of 1.0 and no exposure for XYZ, which is absolute, "
                f"got {self.white} and {self.exposure}"
            )
        if not (math.isfinite(self.white) and self.white > 0.0):
            raise ValueError(f"expected a luminance of white over 0 cd/m2, got {self.white}")
        if not (math.isfinite(self.exposure) and abs(self.exposure) <= 64.0):
            raise ValueError(f"expected an exposure within 64 stops, got {self.exposure}")
        if not 1.0 / BRIGHTEST <= self.gain <= BRIGHTEST:
            raise ValueError(f"expected 1.0 between 1e-12 and 1e12 cd/m2, got {self.gain:g}")

    @classmethod
    def srgb(cls, peak: float = 100.0, exposure: float = 0.0) -> Self:
        """Return a display of sRGB-coded values in [0, 1] whose white has ``peak`` cd/m2.

        Values slightly outside [0, 1] are legal: the linear part of the curve continues below 0
        and the power above 1.
        """
        return cls("srgb", peak, exposure)

    @classmethod
    def linear(cls, white: float = 100.0, exposure: float = 0.0) -> Self:
        """Return a display of linear BT.709 where 1.0 is ``white`` cd/m2; values may exceed 1."""
        return cls("linear", white, exposure)

    @classmethod
    def xyz(cls) -> Self:
        """Return the identity: the image is absolute CIE XYZ in cd/m2."""
        return cls("xyz", 1.0)

    @property
    def gain(self) -> float:
        """The factor from linear values to cd/m2."""
        return self.white * math.exp2(self.exposure)

    def to_xyz(self, image: Tensor, primaries: Tensor) -> Tensor:
        """Return the absolute CIE XYZ, in cd/m2, of pixel values.

        Parameters
        ----------
        image
            (B, 3, H, W).
        primaries
            (3, 3), `BT709_TO_XYZ`; not used for an XYZ image.

        Returns
        -------
        Tensor
            (B, 3, H, W), within +-1e12 cd/m2.
        """
        values = linear_values(image, self.encoding, self.limit(image))
        # The gain multiplies nine matrix entries instead of every pixel.
        return values if self.encoding == "xyz" else mix(primaries * self.gain, values)

    def limit(self, image: Tensor) -> Tensor | None:
        """Return the limit of linear values, like ``image``; None if no code can exceed it."""
        limit = BRIGHTEST / self.gain
        if self.encoding == "srgb" and limit >= LARGEST_CODE**SRGB_EXPONENT:
            return None
        return image.new_full((), limit)

    def to_code(self, image: Tensor) -> Tensor:
        """Return sRGB-coded values: those of an sRGB display, or of light relative to white.

        XYZ has no white, so its light is taken relative to 100 cd/m2. The curve's power continues
        above 1, its linear part below 0. The shape is (B, 3, H, W), as before. This serves a loss:
        0.01 is about as visible on black as on white.
        """
        return codes(image, self.white_scale(image))

    def white_scale(self, image: Tensor) -> Tensor | None:
        """Return what makes values relative to white, like ``image``; None if they are codes."""
        if self.encoding == "srgb":
            return None
        white = XYZ_WHITE if self.encoding == "xyz" else self.white
        return image.new_full((), self.gain / white)


def linear_values(image: Tensor, encoding: str, limit: Tensor | None) -> Tensor:
    """Return the linear values of an image (B, 3, H, W), within +-``limit``."""
    if encoding == "srgb":
        image = decode_srgb(image)
    return image if limit is None else image.clamp(-limit, limit)


def codes(image: Tensor, scale: Tensor | None) -> Tensor:
    """Return `Display.to_code`; ``scale`` is its `white_scale`."""
    if scale is None:
        return within(image, LARGEST_CODE)
    return encode_srgb(within(image * scale, BRIGHTEST))


def encode_srgb(light: Tensor) -> Tensor:
    """Return the sRGB codes of linear values (IEC 61966-2-1), unclipped; 1.0 maps to 1.0."""
    # The base of the power is clamped so that its gradient is finite.
    power = (1.0 + SRGB_OFFSET) * light.clamp_min(SRGB_TOE) ** (1.0 / SRGB_EXPONENT) - SRGB_OFFSET
    return torch.where(light <= SRGB_TOE, SRGB_SLOPE * light, power)


def decode_srgb(image: Tensor) -> Tensor:
    """Return the linear values of sRGB codes (IEC 61966-2-1); 1.0 maps to 1.0."""
    # The base of the power is clamped so that its gradient is finite. The power is written in base
    # 2, the processor's native one: twice as fast, and as exact. Both parts start from the image
    # itself, which a backward pass keeps anyway.
    base = image.clamp(SRGB_KNEE, LARGEST_CODE)
    straight = image.clamp_min(-LARGEST_CODE)
    scale = 1.0 / (1.0 + SRGB_OFFSET)
    if not (torch.is_grad_enabled() and image.requires_grad):
        # The same in place, overwriting what a backward pass would need.
        power = base.add_(SRGB_OFFSET).mul_(scale).log2_().mul_(SRGB_EXPONENT).exp2_()
        return torch.where(image <= SRGB_KNEE, straight.mul_(1.0 / SRGB_SLOPE), power)
    power = torch.exp2(SRGB_EXPONENT * torch.log2((base + SRGB_OFFSET) * scale))
    straight = straight * (1.0 / SRGB_SLOPE)
    return torch.where(image <= SRGB_KNEE, straight, power)


def pixels_per_degree(
    resolution: tuple[int, int], diagonal_inches: float, distance_metres: float
) -> float:
    """Return the pixels in one degree at the centre of a screen.

    Parameters
    ----------
    resolution
        Width and height of the screen in pixels; pixels are square.
    diagonal_inches
        Diagonal of the screen in inches.
    distance_metres
        Distance from the eye to the screen's centre in metres.

    Raises
    ------
    ValueError
        If a number is not positive and finite.
    """
    if not (isinstance(resolution, Sequence) and len(resolution) == 2):
        raise ValueError(f"expected a resolution (width, height), got {resolution!r}")
    numbers = [
        number("resolution, diagonal and distance", value)
        for value in (*resolution, diagonal_inches, distance_metres)
    ]
    if not all(math.isfinite(value) and value > 0 for value in numbers):
        raise ValueError(
            "expected a positive resolution, diagonal (inches) and distance (metres), "
            f"got {resolution}, {diagonal_inches}, {distance_metres}"
        )
    width, height, diagonal, distance = numbers
    pixel_metres = diagonal * 0.0254 / math.hypot(width, height)
    return 2.0 * distance * math.tan(math.radians(0.5)) / pixel_metres
