"""What the channels of an OpenEXR file mean: their colours, and where they lie."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.exr_header import Part, damaged, listed, value_of
from torch_vdm.io.refusal import Floats, ImageError, require_finite

Matrix: TypeAlias = NDArray[np.float64]

# x, y of red, green, blue and white. ITU-R BT.709-6, table 1.
BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# The "primaries" of a file whose R, G, B are CIE X, Y, Z; its white is a formality.
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
# Chromaticities, or coefficients of a conversion, that differ by less are the same but for rounding
# in the file (choice).
SAME_COLOUR = 1e-3

# Cone-like responses for chromatic adaptation, from CIE XYZ (Bradford). ICC.1:2010, annex E.3.
BRADFORD = np.array(
    [(0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296)]
)

# Half of the symmetric filter that makes the chroma between two samples; the first tap is for the
# nearest. A windowed sinc, 27 pixels wide: OpenEXR, ImfRgbaYca.cpp, reconstructChromaHoriz.
CHROMA_TAPS = (0.627123, -0.186077, 0.087929, -0.043159, 0.019597, -0.007540, 0.002128)


def colours(
    part: Part, names: tuple[str, ...], planes: list[Floats], nonfinite: str, notes: list[str]
) -> Floats:
    """The channels `names` as linear BT.709 of the display window's size, shape (3, H, W)."""
    model = tuple(name.rpartition(".")[2] for name in names)
    steps = [part.channels[name].step for name in names]
    x0, y0 = part.window[0] - part.display[0], part.window[1] - part.display[1]
    if model == ("Y", "RY", "BY"):
        if steps[0] != (1, 1) or steps[1] != steps[2] or steps[1] not in ((1, 1), (2, 2)):
            raise ImageError(f"expected chroma at half the resolution of Y, got sampling {steps}")
        # Before anything else, since a NaN would spread over the filter's width.
        luminance = require_finite(planes[0][None], nonfinite, notes, (x0, y0))[0]
        chroma = require_finite(np.stack(planes[1:]), nonfinite, notes, (x0, y0), steps[1][0])
        weights = _rgb_to_xyz(_chromaticities(part))[1]
        image = _from_luminance_chroma(luminance, chroma, weights)
        notes.append("R, G, B are reconstructed from luminance and chroma (Y, RY, BY).")
        image = _placed(image, part, notes)
    else:
        if any(step != (1, 1) for step in steps):
            raise ImageError(
                f"expected a value of {listed(list(names))} in every pixel, got {steps}"
            )
        image = require_finite(_placed(np.stack(planes), part, notes), nonfinite, notes)
    if model == ("Y",):
        notes.append("The image is grey (channel Y): R = G = B.")
        image = np.broadcast_to(image, (3, *image.shape[1:]))
    else:
        image = _to_bt709(image, part, model == ("X", "Y", "Z"), notes)
    _note_scale(part, notes)
    # Once more: what was finite in the file may overflow on the way.
    return require_finite(image, nonfinite, notes)


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
    """Take back colour that the filter made up: where a pixel is saturated and its neighbours not.

    Saturation is 1 - min / max of R, G, B. It may exceed the mean m of the four neighbours only up
    to 1 - (1 - m) / 4; beyond, the colour is pulled towards grey at the same luminance. So negative
    values, of saturation over 1, vanish. The rule is OpenEXR's (ImfRgbaYca.cpp, fixSaturation).
    """
    high = image.max(0)
    with np.errstate(all="ignore"):  # infinite values are dealt with by the caller
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
    """Twice the columns: the samples, and between two what the filter makes of those around."""
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


def _rgb_to_xyz(chromaticities: tuple[float, ...]) -> Matrix:
    """The matrix that gives CIE XYZ, with Y = 1 for R = G = B = 1."""
    xy = np.array(chromaticities, np.float64).reshape(4, 2)
    xyz = np.column_stack((xy, 1 - xy.sum(1)))
    primaries = xyz[:3].T
    with np.errstate(all="ignore"):
        # The determinant is twice the area of the triangle that the primaries make.
        if np.isfinite(xy).all() and abs(np.linalg.det(primaries)) > 1e-6 and xy[3, 1] > 0:
            matrix = primaries * np.linalg.solve(primaries, xyz[3] / xyz[3, 1])
            if np.isfinite(matrix).all() and matrix[1, 1] > 0:
                return matrix
    raise damaged(f"its chromaticities {chromaticities} are no colour space")


def _to_bt709(image: Floats, part: Part, is_xyz: bool, notes: list[str]) -> Floats:
    """Convert primaries, and the white by the Bradford transform.

    Grey stays grey: the file's white becomes BT.709's. XYZ has no white of its own, so X, Y, Z are
    converted as they are, unless an adoptedNeutral says what is to look white.
    """
    if "chromaticities" not in part.attributes and not is_xyz:
        notes.append("No chromaticities are given: BT.709 is assumed, as the format prescribes.")
        return image
    given = XYZ if is_xyz else _chromaticities(part)
    matrix = _rgb_to_xyz(given)
    absolute = np.allclose(given, XYZ, rtol=0, atol=SAME_COLOUR)
    neutral = BT709[6:] if absolute else given[6:]
    if "adoptedNeutral" in part.attributes:
        neutral = value_of(part.attributes, "adoptedNeutral", "<ff")
    to_bt709 = np.linalg.inv(_rgb_to_xyz(BT709)) @ _adaptation(neutral) @ matrix
    if np.allclose(to_bt709, np.eye(3), rtol=0, atol=SAME_COLOUR):
        return image
    space = "CIE XYZ" if absolute else f"primaries {', '.join(f'{c:.4g}' for c in given[:6])}"
    notes.append(
        f"Colours are converted from {space} to BT.709, white from ({neutral[0]:.4g}, "
        f"{neutral[1]:.4g}) to D65."
    )
    with np.errstate(over="ignore", invalid="ignore"):
        converted: Floats = np.tensordot(to_bt709.astype(np.float32), image, 1)
    return converted


def _adaptation(neutral: tuple[float, ...]) -> Matrix:
    """The matrix, XYZ to XYZ, that takes the colour x, y = `neutral` to D65 (Bradford)."""
    x, y = neutral
    if not (0 < x < 1 and 0 < y < 1):
        raise damaged(f"its white ({x:g}, {y:g}) is no colour")
    responses = [BRADFORD @ (u / v, 1, (1 - u - v) / v) for u, v in ((x, y), (BT709[6], BT709[7]))]
    if responses[0].min() <= 0:
        raise damaged(f"its white ({x:g}, {y:g}) is no colour")
    matrix: Matrix = np.linalg.inv(BRADFORD) @ np.diag(responses[1] / responses[0]) @ BRADFORD
    return matrix


def _note_scale(part: Part, notes: list[str]) -> None:
    """Say what the file states and the pixels do not carry."""
    if "whiteLuminance" in part.attributes:
        (white,) = value_of(part.attributes, "whiteLuminance", "<f")
        notes.append(f"The file states that 1.0 is {white:g} cd/m2; pass it with --white.")
    if "pixelAspectRatio" in part.attributes:
        (aspect,) = value_of(part.attributes, "pixelAspectRatio", "<f")
        if abs(aspect - 1) > 1e-3:
            notes.append(f"Pixels are taken as square; the file states a ratio of {aspect:g}.")
