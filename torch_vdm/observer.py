"""Who looks: the parameters of the vision model."""

from dataclasses import dataclass, fields
from typing import Self


@dataclass(frozen=True, kw_only=True)
class Observer:
    """The parameters of an observer, each with its unit; docs/model.md has source and status.

    Attributes
    ----------
    name
        What tables and JSON files call this observer.
    signed
        Whether responses keep the sign of a detail. False: Eq. 4 on the energy, as printed.
    true_means
        Whether a node at the border of an odd side counts for the pixels that it has. False: for
        as many as its siblings, the last row or column repeated.
    dark_light
        The eye's own light, as an equal-energy light in cd/m2, added to what the eye adapts to.
    aberration_cutoff, aberration_exponent
        Attenuation of the S cones, exp(-(f / cutoff)^exponent); cutoff in cycles/degree.
    adaptation_luminance
        The luminance in cd/m2 that sets the contrast sensitivity everywhere; None: the local
        one, each node's parent's lowpass.
    level_gain
        Whether a level's contrast is divided by its wavelet's peak gain.
    achromatic_gain, achromatic_size
        Factor on Barten's sensitivity; its target size in degrees. Never the image's size.
    red_green_gain, yellow_violet_gain
        Sensitivity of C1 and C2 at low frequency.
    chromatic_cutoff, chromatic_order
        Their Butterworth filter; cutoff in cycles/degree.
    red_green_luminance, red_green_exponent, yellow_violet_luminance, yellow_violet_exponent
        How they fall in the dark, (1 + luminance / L)^-exponent; luminance in cd/m2.
    transducer_exponent
        q of the signed transducer 2^q v (1 + v^2)^-q.
    summation_exponent
        The exponent of the distance summation.
    lowpass_gains
        Sensitivity of A, C1, C2 to the Weber contrast between the two images' coarsest lowpass;
        None: never compared, as printed.
    score_exponent, score_coefficients
        The detection score: exponent of its Minkowski sum, and the number of coefficients with
        a response of 1 that together score 1 JND.
    """

    name: str
    signed: bool
    true_means: bool
    dark_light: float
    aberration_cutoff: float
    aberration_exponent: float
    adaptation_luminance: float | None
    level_gain: bool
    achromatic_gain: float
    achromatic_size: float
    red_green_gain: float
    yellow_violet_gain: float
    chromatic_cutoff: float
    chromatic_order: float
    red_green_luminance: float
    red_green_exponent: float
    yellow_violet_luminance: float
    yellow_violet_exponent: float
    transducer_exponent: float
    summation_exponent: float
    lowpass_gains: tuple[float, float, float] | None
    score_exponent: float
    score_coefficients: float

    @classmethod
    def paper(cls) -> Self:
        """Return the observer of Bolin and Meyer 1999, every equation as printed.

        It cannot see a uniform change of brightness or colour, and barely tells a detail from
        its negative.
        """
        return cls(
            name="paper",
            signed=False,  # printed: Eq. 4 takes the energy
            true_means=False,  # choice: repeated level by level, the plainest reading
            dark_light=1e-4,  # cd/m2, choice: only keeps a division by 0 finite
            aberration_cutoff=4.4,  # cpd, fitted to the paper's sentence: < half at 4, none over 8
            aberration_exponent=2.0,
            adaptation_luminance=100.0,  # cd/m2, choice: Barten's own display
            level_gain=False,  # printed: no gain
            achromatic_gain=1.0,  # source: Barten 1989
            achromatic_size=12.0,  # degrees, choice
            red_green_gain=76.0,  # fitted to human thresholds, see docs/model.md
            yellow_violet_gain=36.0,
            chromatic_cutoff=2.29,  # cpd
            chromatic_order=1.09,
            red_green_luminance=0.0,  # cd/m2: one adaptation luminance, so no dimming
            red_green_exponent=0.0,
            yellow_violet_luminance=0.0,
            yellow_violet_exponent=0.0,
            transducer_exponent=0.0,  # of the signed transducer only
            summation_exponent=2.4,  # printed: Eq. 5
            lowpass_gains=None,  # printed: never compared
            score_exponent=4.0,
            score_coefficients=150.0,  # fitted: the median achromatic threshold scores 1
        )

    @classmethod
    def calibrated(cls) -> Self:
        """Return the default observer: it sees signs, uniform changes and the local luminance."""
        return cls(
            name="calibrated",
            signed=True,  # choice: a grating and its negative differ
            true_means=True,  # choice: else one odd pixel outweighs half of the image
            dark_light=0.02,  # cd/m2, choice
            aberration_cutoff=5.24,  # cpd, fitted to a diffraction and defocus model of the eye
            aberration_exponent=2.15,
            adaptation_luminance=None,  # choice: local, as the eye adapts
            level_gain=True,  # choice: a grating at a level's best frequency has its contrast
            achromatic_gain=1.0,  # source: Barten 1989
            achromatic_size=12.0,  # degrees, choice: the map never takes a size
            red_green_gain=76.0,  # fitted to human thresholds, see docs/model.md
            yellow_violet_gain=36.0,
            chromatic_cutoff=2.29,  # cpd, fitted
            chromatic_order=1.09,  # fitted
            red_green_luminance=0.7,
            red_green_exponent=0.2,
            yellow_violet_luminance=0.7,
            yellow_violet_exponent=0.2,
            transducer_exponent=0.4,  # choice: the growth of Eq. 4 far out, r^0.2
            summation_exponent=2.4,  # source: Eq. 5
            lowpass_gains=(20.0, 76.0, 36.0),  # choice: a change of the mean by 5 % is 1 JND
            score_exponent=4.0,
            score_coefficients=150.0,  # fitted: the median achromatic threshold scores 1
        )

    def numbers(self) -> dict[str, float]:
        """Return the parameters that are plain numbers, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: float(value) for name, value in values.items() if type(value) in (float, int)}
