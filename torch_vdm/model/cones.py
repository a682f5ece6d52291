"""Cone fundamentals, the first box of Fig. 2: CIE XYZ to the responses of the S, M, L cones."""

from torch import Tensor

from torch_vdm.model.display import linear_values
from torch_vdm.model.matrix import mix

# Rows S, M, L; columns X, Y, Z. Unit: cone response per cd/m2. Source: Eq. 1 of Bolin and Meyer
# 1999, after Meyer 1988. Status: printed. S depends on Z alone, so a light without Z (the
# reddest of BT.2020) has an S of exactly 0.
XYZ_TO_SML = (
    (0.0000, 0.0000, 0.5609),
    (-0.4227, 1.1723, 0.0911),
    (0.1150, 0.9364, -0.0203),
)


def of_grey(plane: Tensor, grey: Tensor | None) -> Tensor:
    """Return the cone planes (B, 3, h, w) that one plane stands for: ``grey`` (3,) times it.

    Without ``grey`` the plane has three channels already and is returned as it is.
    """
    return plane if grey is None else plane * grey.view(3, 1, 1)


def cone_responses(xyz: Tensor, matrix: Tensor) -> Tensor:
    """Return the S, M, L responses to absolute CIE XYZ (Eq. 1).

    Parameters
    ----------
    xyz
        (B, 3, H, W), absolute CIE XYZ in cd/m2.
    matrix
        (3, 3), ``XYZ_TO_SML``.

    Returns
    -------
    Tensor
        (B, 3, H, W); channels S, M, L.
    """
    return mix(matrix, xyz)


def pixels_to_cones(image: Tensor, encoding: str, limit: Tensor | None, matrix: Tensor) -> Tensor:
    """Return the cone responses (B, 3, H, W) to an image; ``matrix`` applies to linear values.

    ``encoding`` and ``limit`` are those of `linear_values`.
    """
    return cone_responses(linear_values(image, encoding, limit), matrix)
