"""The figures of a frame, by name."""

from typing import NamedTuple


class Figure(NamedTuple):
    """How a figure is shown.

    Attributes
    ----------
    label
        Its short name.
    digits
        Digits after the point.
    percent
        Whether it is a share.
    more_is_better
        False where less is better.
    help
        What it is, in one sentence.
    """

    label: str
    digits: int
    percent: bool
    more_is_better: bool
    help: str


FIGURES = {
    "max_jnd": Figure("max", 2, False, False, "Largest visible difference, JND."),
    "mean_jnd": Figure("mean", 3, False, False, "Mean of the map, JND."),
    "p95_jnd": Figure("p95", 2, False, False, "95 % of the pixels show no more, JND."),
    "visible_fraction": Figure("visible", 1, True, False, "Share of the pixels over 1 JND."),
    "mean_luminance_change": Figure(
        "luminance", 2, True, False, "Mean luminance of the test relative to the reference."
    ),
    "flicker_max_jnd": Figure(
        "flicker", 2, False, False, "Largest visible change of the error since the frame before."
    ),
    "flicker_mean_jnd": Figure(
        "flicker mean", 3, False, False, "Mean visible change of the error, JND."
    ),
    "flicker_visible_fraction": Figure(
        "flicker visible", 1, True, False, "Share of the pixels whose error changes by over 1 JND."
    ),
    "psnr": Figure("PSNR", 1, False, True, "dB, sRGB-coded; none where the images are equal."),
    "ssim": Figure("SSIM", 4, False, True, "Mean over the image, luma, sRGB-coded."),
    "flip": Figure("FLIP", 4, False, False, "Mean error, sRGB-coded."),
    "cvvdp": Figure("cvvdp", 2, False, True, "Quality in JOD, 10 is best."),
}
