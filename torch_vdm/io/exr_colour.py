"""What the channels of an OpenEXR file mean: their colours, and where they lie."""

import numpy as np

from torch_vdm.io import alpha
from torch_vdm.io.exr_header import Part, listed, value_of
from torch_vdm.io.exr_layers import Layer
from torch_vdm.io.primaries import (
    BT709,
    SAME_COLOUR,
    XYZ,
    Matrix,
    converted,
    is_identity,
    rgb_to_xyz,
    to_bt709,
)
from torch_vdm.io.refusal import (
    Floats,
    ImageError,
    Repair,
    require_finite,
    without_negatives,
)

# Half of the symmetric filter that interpolates the chroma between two samples; the first tap is
# for the nearest. It is a windowed sinc, 27 pixels wide: OpenEXR, ImfRgbaYca.cpp,
# reconstructChromaHoriz.
CHROMA_TAPS = (0.627123, -0.186077, 0.087929, -0.043159, 0.019597, -0.007540, 0.002128)


# The largest finite number of a channel's type: whole numbers (always finite), half, float.
LARGEST = (np.float32(2**32), np.float32(65504), np.finfo(np.float32).max)


def colours(
    part: Part,
    layer: Layer,
    decoded: dict[str, Floats],
    repair: Repair,
    coded: bool,
    notes: list[str],
) -> Floats:
    """The layer as linear BT.709 of the display window's size, shape (3, H, W).

    With ``coded`` the values are sRGB-coded, and stay so.
    """
    steps = [part.channels[name].step for name in layer.channels]
    planes = [decoded[name].astype(np.float32) for name in layer.channels]
    largest = _largest(part, layer.channels)
    x0, y0 = part.window[0] - part.display[0], part.window[1] - part.display[1]
    if layer.model == ("Y", "RY", "BY"):
        if steps[0] != (1, 1) or steps[1] != steps[2] or steps[1] not in ((1, 1), (2, 2)):
            raise ImageError(f"expected chroma at half the resolution of Y, got sampling {steps}")
        # Before anything else, since a NaN would spread over the filter's width.
        luminance = require_finite(
            planes[0][None], repair.nonfinite, notes, (x0, y0), largest=largest[:1]
        )[0]
        chroma = require_finite(
            np.stack(planes[1:]), repair.nonfinite, notes, (x0, y0), steps[1][0], largest[1:]
        )
        weights = rgb_to_xyz(_chromaticities(part))[1]
        image = _from_luminance_chroma(luminance, chroma, weights)
        notes.append("R, G, B are reconstructed from luminance and chroma (Y, RY, BY).")
        image = require_finite(_placed(image, part, notes), repair.nonfinite, notes)
    else:
        image = _placed(np.stack(_whole(planes, steps, layer.channels)), part, notes)
        image = require_finite(image, repair.nonfinite, notes, largest=largest)
    # Only the file's own: conversion of colours outside BT.709 makes others, which are legal.
    image = without_negatives(image, repair.negative, notes)
    if layer.model == ("Y",):
        notes.append("The image is grey (channel Y): R = G = B.")
        image = np.broadcast_to(image, (3, *image.shape[1:]))
    elif coded:
        _require_bt709(part, layer)
    else:
        image = _to_bt709(image, part, layer.model == ("X", "Y", "Z"), notes)
    _note_scale(part, notes)
    # Once more: what was finite in the file may overflow in the conversion.
    return require_finite(image, repair.nonfinite, notes)


def transparency(part: Part, name: str, decoded: dict[str, Floats], notes: list[str]) -> Floats:
    """An alpha channel, (H, W) of the display window's size."""
    planes = _whole([decoded[name].astype(np.float32)], [part.channels[name].step], (name,))
    return alpha.plane(_placed(np.stack(planes), part, [])[0], notes)


def _whole(
    planes: list[Floats], steps: list[tuple[int, int]], names: tuple[str, ...]
) -> list[Floats]:
    """The planes, which must have a value in every pixel."""
    if any(step != (1, 1) for step in steps):
        raise ImageError(f"expected a value of {listed(list(names))} in every pixel, got {steps}")
    return planes


def _largest(part: Part, names: tuple[str, ...]) -> Floats:
    return np.array([LARGEST[part.channels[name].kind] for name in names], np.float32)


def _from_luminance_chroma(luminance: Floats, chroma: Floats, weights: Matrix) -> Floats:
    """(H, W) and (2, H or H/2, W or W/2) to (3, H, W): RY = (R - Y) / Y, BY = (B - Y) / Y."""
    chroma_is_whole = chroma.shape[1:] == luminance.shape
    if not chroma_is_whole:
        chroma = _doubled(_doubled(chroma).swapaxes(1, 2)).swapaxes(1, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        red, blue = (chroma + 1) * luminance
        green = (luminance - weights[0] * red - weights[2] * blue) / weights[1]
    image = np.stack((red, green.astype(np.float32), blue))
    return image if chroma_is_whole else _less_saturated(image, weights)


def _less_saturated(image: Floats, weights: Matrix) -> Floats:
    """Remove colour that the filter made up: where a pixel is saturated and its neighbours are not.

    Saturation is 1 - min / max of R, G, B. It may exceed the mean m of the four neighbours only up
    to 1 - (1 - m) / 4; beyond that, the colour is pulled towards grey at the same luminance. So
    negative values, with a saturation over 1, vanish. The rule is OpenEXR's (ImfRgbaYca.cpp,
    fixSaturation).
    """
    high = image.max(0)
    with np.errstate(all="ignore"):  # infinite values are handled by the caller
        saturation = np.where(high > 0, 1 - image.min(0) / high, np.float32(0))
        wide = np.pad(saturation, 1, mode="edge")
        mean = (wide[1:-1, :-2] + wide[1:-1, 2:] + wide[:-2, 1:-1] + wide[2:, 1:-1]) / 4
        limit = 1 - (1 - np.minimum(mean, 1)) / 4
        greyer = np.maximum(high - (high - image) * (limit / saturation), 0)
        before, after = (np.tensordot(weights.astype(np.float32), x, 1) for x in (image, greyer))
        greyer *= np.where(after > 0, before / after, np.float32(1))
    limited: Floats = np.where(saturation > limit, greyer, image)
    return limited


def _doubled(samples: Floats) -> Floats:
    """Twice the columns: the samples, and between them those that the filter interpolates."""
    count, reach = samples.shape[-1], len(CHROMA_TAPS)
    wide = np.pad(samples, ((0, 0), (0, 0), (reach - 1, reach)), mode="edge")
    between = np.zeros_like(samples)
    for i, tap in enumerate(CHROMA_TAPS):
        left, right = reach - 1 - i, reach + i
        between += np.float32(tap) * (
            wide[..., left : left + count] + wide[..., right : right + count]
        )
    return np.stack((samples, between), -1).reshape(*samples.shape[:-1], 2 * count)


def _placed(planes: Floats, part: Part, notes: list[str]) -> Floats:
    """The display window: the data where there are any, 0 elsewhere."""
    if part.window == part.display:
        return planes
    x0, y0, x1, y1 = part.display
    shown = np.zeros((len(planes), y1 - y0 + 1, x1 - x0 + 1), np.float32)
    left, top = max(x0, part.window[0]), max(y0, part.window[1])
    right, bottom = min(x1, part.window[2]), min(y1, part.window[3])
    windows = (
        f"the data window ({part.window[0]}, {part.window[1]}) to ({part.window[2]}, "
        f"{part.window[3]}) and the display window ({x0}, {y0}) to ({x1}, {y1})"
    )
    if left > right or top > bottom:
        notes.append(f"The image is all 0: {windows} have no pixel in common.")
        return shown
    source = planes[
        :,
        top - part.window[1] : bottom + 1 - part.window[1],
        left - part.window[0] : right + 1 - part.window[0],
    ]
    shown[:, top - y0 : bottom + 1 - y0, left - x0 : right + 1 - x0] = source
    notes.append(
        f"The image has the size of the display window, and 0 where there are no data: {windows} "
        "differ."
    )
    return shown


def _chromaticities(part: Part) -> tuple[float, ...]:
    if "chromaticities" not in part.attributes:
        return BT709
    return value_of(part.attributes, "chromaticities", "<8f")


def _to_bt709(image: Floats, part: Part, is_xyz: bool, notes: list[str]) -> Floats:
    """Convert primaries, and the white by the Bradford transform.

    Grey stays grey: the file's white becomes BT.709's. XYZ has no white of its own, so X, Y, Z are
    converted as they are, unless an adoptedNeutral states what is to look white.
    """
    if "chromaticities" not in part.attributes and not is_xyz:
        notes.append("No chromaticities are given: BT.709 is assumed, as the format prescribes.")
        return image
    given = XYZ if is_xyz else _chromaticities(part)
    matrix = rgb_to_xyz(given)
    absolute = np.allclose(given, XYZ, rtol=0, atol=SAME_COLOUR)
    neutral = BT709[6:] if absolute else given[6:]
    if "adoptedNeutral" in part.attributes:
        neutral = value_of(part.attributes, "adoptedNeutral", "<ff")
    conversion = to_bt709(matrix, neutral)
    if is_identity(conversion):
        return image
    space = "CIE XYZ" if absolute else f"primaries {', '.join(f'{c:.4g}' for c in given[:6])}"
    notes.append(
        f"Colours are converted from {space} to BT.709, white from ({neutral[0]:.4g}, "
        f"{neutral[1]:.4g}) to D65."
    )
    return converted(image, conversion)


def _require_bt709(part: Part, layer: Layer) -> None:
    """Refuse colours that need a conversion, which coded values do not allow."""
    matrix = np.eye(3)
    if "chromaticities" in part.attributes:
        given = _chromaticities(part)
        matrix = to_bt709(rgb_to_xyz(given), given[6:])
    if layer.model != ("R", "G", "B") or not is_identity(matrix):
        raise ImageError(
            "expected sRGB-coded R, G, B in BT.709 (--coded), got other colours; leave out --coded"
        )


def _note_scale(part: Part, notes: list[str]) -> None:
    """Note what the file states and the pixels do not carry."""
    if "whiteLuminance" in part.attributes:
        (white,) = value_of(part.attributes, "whiteLuminance", "<f")
        notes.append(f"The file states that 1.0 is {white:g} cd/m2; pass it with --white.")
    if "pixelAspectRatio" in part.attributes:
        (aspect,) = value_of(part.attributes, "pixelAspectRatio", "<f")
        if abs(aspect - 1) > 1e-3:
            notes.append(f"Pixels are taken as square; the file states a ratio of {aspect:g}.")
