"""Local contrast and opponents contrast space, the fourth and fifth boxes of Fig. 2."""

from torch import Tensor

from torch_vdm.model.limit import within
from torch_vdm.model.matrix import mix

# Rows A, C1, C2; columns S, M, L. Unit: opponent contrast per cone contrast. Source: Eq. 3 of
# Bolin and Meyer 1999, after Meyer 1988. Status: printed. Applied to cone contrasts it is not
# opponent: a grey contrast of 1 gives A = 1.0147, C1 = 0.4150, C2 = 0.8904.
SML_TO_OPPONENTS = (
    (0.0001, 0.2499, 0.7647),
    (0.0018, 2.9468, -2.5336),
    (1.0111, -0.3877, 0.2670),
)

# Contrasts are clamped to this: those of light cannot exceed 4, but values below 0, which are not
# light, have unbounded contrasts, whose powers would overflow. Status: choice.
LARGEST = 1e10


def adapted(lowpass: Tensor, dark_light: Tensor) -> Tensor:
    """Return what the cones are adapted to: their lowpass, clamped at 0, plus the eye's dark light.

    ``lowpass`` is (B, 3, h, w) and may be slightly negative (light out of gamut);
    ``dark_light`` is (3,), in cone responses. The result is positive, so it is safe to divide by.
    """
    return lowpass.clamp_min(0.0) + dark_light.view(3, 1, 1)


def local_contrast(details: Tensor, scale: Tensor) -> Tensor:
    """Divide the details by the adapted lowpass one level up (Section 2, "local contrast").

    Parameters
    ----------
    details
        (B, 3, orientations, h, w); cones S, M, L.
    scale
        (B, 3, h, w): one over what `adapted` gives for the parent of each node, not for the node
        itself. For non-negative light a contrast is then at most 4, at a border 7.

    Returns
    -------
    Tensor
        (B, 3, orientations, h, w), dimensionless cone contrast.
    """
    return within(details * scale.unsqueeze(2), LARGEST)


def weber_contrast(first: Tensor, second: Tensor, dark_light: Tensor) -> Tensor:
    """Return the contrast between two lowpass planes (B, 3, h, w), relative to their mean.

    It is antisymmetric, and at most 2 for non-negative light.
    """
    mean = 0.5 * (adapted(first, dark_light) + adapted(second, dark_light))
    return within((first - second) / mean, LARGEST)


def opponents(contrast: Tensor, matrix: Tensor) -> Tensor:
    """Return the opponent contrasts A, C1, C2 of cone contrasts (Eq. 3).

    ``contrast`` is (B, 3, ...); ``matrix`` (N, 3) holds the rows of `SML_TO_OPPONENTS` that are
    wanted; the result is (B, N, ...).
    """
    return mix(matrix, contrast)
