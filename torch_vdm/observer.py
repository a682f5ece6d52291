"""Who looks: the parameters of the vision model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

from torch_vdm.options import number, switch

# What is divided by, or is a root or a filter's place: never 0.
POSITIVE = (
    "dark_light",
    "aberration_cutoff",
    "adaptation_luminance",
    "achromatic_size",
    "glare_luminance",
    "peak_frequency",
    "band_width",
    "red_green_cutoff",
    "yellow_violet_cutoff",
    "summation_exponent",
)


# What the fit gives with other transforms than `Haar()`, whose numbers `Observer.calibrated` has,
# by the transform's class and `csf`. Status: fitted, `python -m benchmarks calibrate`.
FITTED: dict[tuple[str, str], dict[str, float]] = {
    ("StationaryHaar", "filter"): {
        "achromatic_gain": 288,
        "dim_luminance": 20.2,
        "achromatic_dimming": 0.217,
        "glare_exponent": 0.421,
        "peak_frequency": 2.56,
        "peak_exponent": 0.18,
        "band_width": 1.74,
        "band_floor": 0.957,
        "red_green_gain": 310,
        "red_green_cutoff": 0.735,
        "yellow_violet_gain": 125,
        "yellow_violet_cutoff": 0.774,
    },
    ("Steerable", "levels"): {
        "achromatic_gain": 714,
        "dim_luminance": 21,
        "achromatic_dimming": 0.136,
        "glare_exponent": 0.327,
        "peak_frequency": 3.05,
        "peak_exponent": 0.213,
        "band_width": 1.49,
        "band_floor": 0.62,
        "red_green_gain": 778,
        "red_green_cutoff": 0.613,
        "yellow_violet_gain": 389,
        "yellow_violet_cutoff": 0.355,
    },
    ("StationaryHaar", "levels"): {
        "achromatic_gain": 347,
        "dim_luminance": 19.1,
        "achromatic_dimming": 0.192,
        "glare_exponent": 0.392,
        "peak_frequency": 2.59,
        "peak_exponent": 0.172,
        "band_width": 1.45,
        "band_floor": 0.428,
        "red_green_gain": 380,
        "red_green_cutoff": 0.57,
        "yellow_violet_gain": 141,
        "yellow_violet_cutoff": 0.635,
    },
    ("Haar", "filter"): {
        "achromatic_gain": 299,
        "dim_luminance": 20.9,
        "achromatic_dimming": 0.232,
        "glare_exponent": 0.391,
        "peak_frequency": 2.17,
        "peak_exponent": 0.172,
        "band_width": 1.71,
        "band_floor": 0.429,
        "red_green_gain": 311,
        "red_green_cutoff": 0.574,
        "yellow_violet_gain": 130,
        "yellow_violet_cutoff": 0.621,
    },
}


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
        The luminance in cd/m2 that sets the contrast sensitivity everywhere, by Barten's formula
        and without dimming of the chromatic channels; None: the local one, each node's parent's
        lowpass, and the fitted curve.
    level_gain
        Whether a level's contrast is divided by its wavelet's peak gain.
    achromatic_gain
        Factor on Barten's sensitivity; or the sensitivity of A at its peak in bright light.
    achromatic_size
        Barten's target size in degrees. Never the image's size.
    dim_luminance, achromatic_dimming, chromatic_dimming
        How sensitivity falls in the dark, (1 + luminance / L)^-exponent; luminance in cd/m2.
    glare_luminance, glare_exponent
        How that of A falls in glare, (1 + L / luminance)^-exponent.
    peak_frequency, peak_luminance, peak_exponent
        Where A's sensitivity peaks, frequency (1 + luminance / L)^-exponent; cycles/degree.
    band_width, band_floor
        Its width in octaves, to 1/e of the peak; what is left of it far below the peak.
    red_green_gain, red_green_cutoff, red_green_order
        C1's Butterworth filter: sensitivity at low frequency, cutoff in cycles/degree, order.
    yellow_violet_gain, yellow_violet_cutoff, yellow_violet_order
        C2's.
    transducer_exponent
        q of the signed transducer 2^q v (1 + v^2)^-q.
    summation_exponent
        The exponent of the distance summation.
    lowpass_gains
        Sensitivity of A, C1, C2 to the Weber contrast between the two images' coarsest lowpass;
        None: never compared, as printed.
    charging
        Whether a coarse difference counts only for the pixels that made it. False: for all
        below it, as printed.
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
    dim_luminance: float
    achromatic_dimming: float
    chromatic_dimming: float
    glare_luminance: float
    glare_exponent: float
    peak_frequency: float
    peak_luminance: float
    peak_exponent: float
    band_width: float
    band_floor: float
    red_green_gain: float
    red_green_cutoff: float
    red_green_order: float
    yellow_violet_gain: float
    yellow_violet_cutoff: float
    yellow_violet_order: float
    transducer_exponent: float
    summation_exponent: float
    lowpass_gains: tuple[float, float, float] | None
    charging: bool

    def __post_init__(self) -> None:
        """Refuse what no observer has; numbers of NumPy or torch become Python's."""
        if not isinstance(self.name, str):
            raise ValueError(f"expected name: a string, got {self.name!r}")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.type is bool:
                switch(field.name, value)
            elif field.type is float or (field.type == float | None and value is not None):
                object.__setattr__(self, field.name, number(field.name, value))
        gains = self.lowpass_gains
        if gains is not None:
            if not isinstance(gains, Sequence) or isinstance(gains, str) or len(gains) != 3:
                raise ValueError(f"expected lowpass_gains: three or None, got {gains!r}")
            several = tuple(number("lowpass_gains", gain) for gain in gains)
            object.__setattr__(self, "lowpass_gains", several)
        numbers = self.numbers()
        numbers |= {
            f"lowpass_gains[{place}]": gain for place, gain in enumerate(self.lowpass_gains or ())
        }
        for name, value in numbers.items():
            if not math.isfinite(value) or value < 0.0 or (name in POSITIVE and value == 0.0):
                least = "a finite number over 0" if name in POSITIVE else "a finite number from 0"
                raise ValueError(f"expected {name}: {least}, got {value}")

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
            # One adaptation luminance and Barten's formula: none of these.
            dim_luminance=0.0,
            achromatic_dimming=0.0,
            chromatic_dimming=0.0,
            glare_luminance=1.0,
            glare_exponent=0.0,
            peak_frequency=1.0,
            peak_luminance=0.0,
            peak_exponent=0.0,
            band_width=1.0,
            band_floor=0.0,
            # Fitted to human thresholds, one curve for both: docs/model.md.
            red_green_gain=76.0,
            red_green_cutoff=2.29,  # cpd
            red_green_order=1.09,
            yellow_violet_gain=36.0,
            yellow_violet_cutoff=2.29,
            yellow_violet_order=1.09,
            transducer_exponent=0.0,  # of the signed transducer only
            summation_exponent=2.4,  # printed: Eq. 5
            lowpass_gains=None,  # printed: never compared
            charging=False,  # printed: every path has all of its nodes
        )

    @classmethod
    def calibrated(cls) -> Self:
        """Return the default observer: it sees signs, uniform changes and the local luminance.

        Its numbers are those fitted with `Haar()`; `VDM` puts those of its own transform in their
        place, see `fitted_to`.
        """
        return cls(
            name="calibrated",
            signed=True,  # choice: a grating and its negative differ
            true_means=True,  # choice: else one odd pixel outweighs half of the image
            # cd/m2, choice: left free, the fit takes 0.00025, within a factor of 1.6; held
            dark_light=0.0003,
            aberration_cutoff=5.24,  # cpd, source: a model of the eye, docs/model.md; held
            aberration_exponent=2.15,
            adaptation_luminance=None,  # choice: local, as the eye adapts
            level_gain=True,  # choice: a grating at a level's best frequency has its contrast
            achromatic_gain=279,
            achromatic_size=12.0,  # degrees; of Barten's formula only
            dim_luminance=19.5,
            achromatic_dimming=0.211,
            chromatic_dimming=0.5,  # source: de Vries and Rose, noise of photons; held
            glare_luminance=2000.0,
            glare_exponent=0.362,
            peak_frequency=2.9,
            peak_luminance=300.0,
            peak_exponent=0.157,
            band_width=1.5,
            band_floor=0.428,
            red_green_gain=370,
            red_green_cutoff=0.501,
            red_green_order=1.0,  # choice: thresholds tell it from 0.9 by 0.05 dB; held
            yellow_violet_gain=149,
            yellow_violet_cutoff=0.476,
            yellow_violet_order=1.0,  # as that of C1
            transducer_exponent=0.3,  # choice: masking rises with Legge and Foley's slope, 0.6
            summation_exponent=6.0,  # choice, by experiment: 2.4 and 4 make too much of noise
            lowpass_gains=(20.0, 76.0, 36.0),  # choice: a change of the mean by 5 % is 1 JND
            charging=True,  # choice: else a lamp is seen everywhere
        )

    def fitted_to(self, transform: object) -> Self:
        """Return the observer with the numbers that were fitted with a transform.

        ``transform`` is one of `torch_vdm.cortex`. Numbers that are not those of `calibrated` stay
        as they are, and so does an observer of another name.
        """
        kind = type(transform).__name__, str(getattr(transform, "csf", ""))
        if self.name != "calibrated" or kind not in FITTED:
            return self
        ours = type(self).calibrated()
        numbers: dict[str, Any] = {
            name: value
            for name, value in FITTED[kind].items()
            if getattr(self, name) == getattr(ours, name)
        }
        return replace(self, **numbers)

    def numbers(self) -> dict[str, float]:
        """Return the parameters that are plain numbers, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, float)}
