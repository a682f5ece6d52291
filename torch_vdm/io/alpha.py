"""Transparency: a picture over a background of one colour."""

import re

import numpy as np

from torch_vdm.io.curves import decode_srgb
from torch_vdm.io.decoded import Decoded, Kind
from torch_vdm.io.refusal import Floats

# Named backgrounds, sRGB-coded. Grey is half of white's code, #808080.
BACKGROUNDS = {"black": "#000000", "white": "#ffffff", "grey": "#808080", "gray": "#808080"}

# The luminance of a white background behind absolute light, cd/m2. Source: ITU-R BT.2408-7, 2.2,
# the white of a diffuse reflector in HDR pictures.
ABSOLUTE_WHITE = 203.0


def colour(background: str) -> tuple[float, float, float]:
    """Return a background's sRGB-coded red, green and blue, from its name or ``#rrggbb``.

    Raises
    ------
    ValueError
        If it is neither.
    """
    text = BACKGROUNDS.get(background.lower(), background)
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        raise ValueError(
            f"expected black, white, grey or #rrggbb for the background, got {background!r}"
        )
    red, green, blue = (int(text[at : at + 2], 16) / 255 for at in (1, 3, 5))
    return red, green, blue


def plane(values: Floats, notes: list[str]) -> Floats:
    """Return an alpha plane clamped to [0, 1]; NaN, which some renderers write, is opaque."""
    unknown = np.isnan(values)
    if unknown.any():
        notes.append(f"{int(unknown.sum())} values of alpha are NaN, and taken as opaque.")
    held: Floats = np.where(unknown, np.float32(1), values).clip(np.float32(0), np.float32(1))
    return held


def over(image: Decoded, background: str, notes: list[str]) -> Floats:
    """Return the pixels (3, H, W) of an image over a background.

    They are composited in the image's own values: sRGB codes as browsers do it, light as renderers
    do it. Straight colours are multiplied by alpha, associated ones already are.
    """
    if image.alpha is None or (image.alpha == 1).all():
        return image.pixels
    sort = "associated" if image.associated else "straight"
    values = "sRGB-coded values" if image.kind == "coded" else "linear light"
    notes.append(
        f"It is transparent, and shown over {background} (--background): {sort} alpha, {values}."
    )
    behind = np.array(_values(background, image.kind), np.float32)[:, None, None]
    if image.associated:
        return image.pixels if not behind.any() else image.pixels + (1 - image.alpha) * behind
    return image.pixels * image.alpha + (1 - image.alpha) * behind


def straight(pixels: Floats, alpha: Floats) -> Floats:
    """Return associated colours divided by alpha; where alpha is 0 they are kept."""
    divisor: Floats = np.where(alpha > 0, alpha, np.float32(1))
    return pixels / divisor


def _values(background: str, kind: Kind) -> tuple[float, ...]:
    coded = colour(background)
    if kind == "coded":
        return coded
    white = ABSOLUTE_WHITE if kind == "absolute" else 1.0
    return tuple(white * float(light) for light in decode_srgb(np.array(coded)))
