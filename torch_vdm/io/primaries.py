"""Colour spaces by their numbers: primaries, white, and the conversion to linear BT.709."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.refusal import Floats, ImageError

Matrix: TypeAlias = NDArray[np.float64]
Chromaticities: TypeAlias = tuple[float, ...]

# x, y of red, green, blue and white. ITU-R BT.709-6, table 1.
BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# ITU-R BT.2020-2, table 3.
BT2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
# SMPTE EG 432-1: P3 with the white of D65, as displays have it.
P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
# SMPTE RP 431-2: P3 as cinemas have it.
DCI_P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351)
# The "primaries" of a file whose R, G, B are CIE X, Y, Z; its white is a formality.
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
# The white of ICC profiles' connection space, X, Y, Z. ICC.1:2022, 7.2.16.
D50 = (0.9642, 1.0, 0.8249)

# Chromaticities, or coefficients of a conversion, that differ by less are equal except for rounding
# in the file (choice).
SAME_COLOUR = 1e-3

# Cone-like responses for chromatic adaptation, from CIE XYZ (Bradford). ICC.1:2010, annex E.3.
BRADFORD = np.array(
    [(0.8951, 0.2664, -0.1614), (-0.7502, 1.7135, 0.0367), (0.0389, -0.0685, 1.0296)]
)


def rgb_to_xyz(chromaticities: Chromaticities) -> Matrix:
    """Return the matrix that gives CIE XYZ, with Y = 1 for R = G = B = 1."""
    xy = np.array(chromaticities, np.float64).reshape(4, 2)
    xyz = np.column_stack((xy, 1 - xy.sum(1)))
    primaries = xyz[:3].T
    with np.errstate(all="ignore"):
        # The determinant is twice the area of the triangle that the primaries make.
        if np.isfinite(xy).all() and abs(np.linalg.det(primaries)) > 1e-6 and xy[3, 1] > 0:
            matrix = primaries * np.linalg.solve(primaries, xyz[3] / xyz[3, 1])
            if np.isfinite(matrix).all() and matrix[1, 1] > 0:
                return matrix
    raise ImageError(
        f"damaged: its chromaticities {tuple(chromaticities)} are no colour space; export it again"
    )


def to_bt709(matrix: Matrix, neutral: tuple[float, ...]) -> Matrix:
    """Return the conversion to linear BT.709 of colours that `matrix` takes to CIE XYZ.

    The colour x, y = `neutral` becomes D65, by the Bradford transform.
    """
    to_linear: Matrix = np.linalg.inv(rgb_to_xyz(BT709)) @ _adaptation(neutral) @ matrix
    return to_linear


def is_identity(matrix: Matrix) -> bool:
    """Whether a conversion does nothing, except for rounding in the file."""
    return np.allclose(matrix, np.eye(3), rtol=0, atol=SAME_COLOUR)


def converted(image: Floats, matrix: Matrix) -> Floats:
    """Return a matrix times an image (3, H, W); what overflows is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        result: Floats = np.tensordot(matrix.astype(np.float32), image, 1)
    return result


def _adaptation(neutral: tuple[float, ...]) -> Matrix:
    """The matrix, XYZ to XYZ, that takes the colour x, y = `neutral` to D65 (Bradford)."""
    x, y = neutral
    no_colour = ImageError(f"damaged: its white ({x:g}, {y:g}) is no colour; export it again")
    if not (0 < x < 1 and 0 < y < 1):
        raise no_colour
    responses = [BRADFORD @ (u / v, 1, (1 - u - v) / v) for u, v in ((x, y), (BT709[6], BT709[7]))]
    if responses[0].min() <= 0:
        raise no_colour
    matrix: Matrix = np.linalg.inv(BRADFORD) @ np.diag(responses[1] / responses[0]) @ BRADFORD
    return matrix
