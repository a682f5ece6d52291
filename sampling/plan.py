"""Which effects of a scene are simulated: those that it needs and that anyone could see.

First the scene is read: without media no volumetric integrator is needed, and where no surface
scatters, no light has been reflected twice. Then a pilot measures what each further bounce of light
adds, and the metric judges whether anyone could see it. What is left out has a bound in JND, and
the noise may use only the rest of the tolerance: both together stay within it.

The pilot is the first round of the run, and its samples stay in the picture. Where nothing is left
out, the picture is that of ``--effects full``, bit for bit; where paths are cut, it is that of a
scene that asks for no longer ones.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from sampling.renderers import Samples
from sampling.renderers.mitsuba import Bounced, MitsubaRenderer
from sampling.renderers.needs import PATH, Needs
from sampling.sampler import Request, Sampler, Settings
from sampling.statistics import Statistics

# The values of `effects`.
AUTO, FULL = "auto", "full"

# Largest share of the tolerance that what is left out may use. Status: choice.
SHARE = 0.25

# Depths at which paths may be cut, in segments. Status: choice.
CUTS = (2, 3, 4, 6, 8, 12)

# Fewest samples per pixel from which a pilot can tell anything. Fewest pixels, because its code
# takes a quarter of a second to compile, and most pixels, because it is kept in memory, 576 bytes
# each. Status: choices.
FEWEST_SAMPLES, FEWEST_PIXELS, MOST_PIXELS = 16, 2**18, 2**20

# Before the pilot, one sample each of about so many pixels tells whether a cut could save anything
# and would not obviously show. The mean of the picture decides that, with a factor because some
# places differ more. Status: choice; a bound was 4 to 10 times the mean's difference on dim rooms
# and open scenes.
GLANCED, LOCAL = 2**13, 4.0

# The samples grow with this power of one over the tolerance. Status: measured, the Cornell box from
# 2 to 1 JND, 249 and 1,200 samples per pixel.
STEEP = 2.3

# The rest must cost at most this share, or everything is kept. Status: choice.
WORTH = 0.95

# Paths that compiled code follows together, until the longest has ended. Status: choice, as with
# AVX-512; the same on every machine, because the image must not depend on it.
LANES = 16

# Samples that are drawn at once. Status: choice.
AT_ONCE = 2**18


@dataclass(frozen=True)
class Plan:
    """What is simulated, and what is not."""

    integrator: str | None
    """The integrator in place of the scene's own; None: its own."""
    max_depth: int | None
    """Most path segments of ``integrator``; None: no limit."""
    bound: float
    """Bound in JND on how much of what is left out may show; 0 where nothing is."""
    left_out: tuple[str, ...]
    """What is left out, in words with reasons."""
    kept: tuple[str, ...]
    """What was considered and kept, with reasons."""
    evidence: dict[str, Any]
    """What was measured: figures by name."""

    @classmethod
    def of(cls, kept: str) -> Self:
        """Return the plan that leaves out nothing, with the reason."""
        return cls(None, None, 0.0, (), (kept,), {})

    def ended(self) -> Self:
        """Return the plan of a run that ended before a pilot could say more."""
        return replace(self, kept=(*self.kept, "every bounce: the run ended with its first round"))

    def words(self) -> list[str]:
        """Return what is left out and what is kept, one line each."""
        return [f"left out: {each}" for each in self.left_out] + [
            f"kept: {each}" for each in self.kept
        ]

    def figures(self) -> dict[str, Any]:
        """Return the same for the JSON."""
        return {
            "why": "; ".join(self.words()),
            "left_out": list(self.left_out),
            "kept": list(self.kept),
            "left_out_jnd": self.bound,
            "evidence": self.evidence,
        }

    def state(self) -> dict[str, Any]:
        """Return the plan as numbers, strings and lists, for `restored`."""
        return asdict(self)

    @classmethod
    def restored(cls, state: dict[str, Any]) -> Self:
        """Return the plan whose `state` this is."""
        lists = {name: tuple(state[name]) for name in ("left_out", "kept")}
        return cls(**{**state, **lists})


def read(
    needs: Needs, effects: str, settings: Settings, size: tuple[int, int]
) -> tuple[Plan, bool]:
    """Return the plan by the scene alone, and whether a pilot is to refine it."""
    if effects == FULL:
        return Plan.of("all that the scene names, as asked"), False
    if needs.integrator is None:
        return Plan.of(
            "all that the scene names: only path, volpath and volpathmis by themselves, with "
            "visible emitters, are looked into"
        ), False
    left: list[str] = []
    if needs.integrator != PATH:
        reason = _volumetric(needs)
        if reason is not None:
            return Plan.of(f"{needs.integrator}: {reason}"), False
        left.append(
            f"{needs.integrator}'s walk through media: the scene has none, path gives the same "
            "picture"
        )
    depth = needs.max_depth
    if not (needs.scatters or needs.passes or needs.unread) and (depth is None or depth > 2):
        left.append("paths of more than 2 segments: no surface scatters light")
        depth = 2
    kept = _unpiloted(needs._replace(max_depth=depth), settings, size)
    plan = Plan(
        PATH if left else None,
        depth if left else None,
        0.0,
        tuple(left),
        () if kept is None else (kept,),
        {},
    )
    return plan, kept is None


def _volumetric(needs: Needs) -> str | None:
    """Return why a volumetric integrator is needed; None where it is not."""
    if needs.media:
        return "the scene has media"
    if needs.passes:
        return "light passes through some surface without a bend, which it takes for none"
    return "the scene has instances, and media inside them are not read" if needs.unread else None


def _unpiloted(needs: Needs, settings: Settings, size: tuple[int, int]) -> str | None:
    """Return why every bounce is kept without a pilot; None: a pilot is to decide."""
    if needs.max_depth is not None and needs.max_depth <= CUTS[0]:
        return f"paths of {needs.max_depth} segments, as the scene has it"
    if not needs.tellable:
        return "every bounce: only compiled variants in RGB tell them apart"
    if needs.broad_lights and (needs.mirrors or needs.passes or needs.unread):
        return (
            "every bounce: light that comes by way of a mirror, or of what is clear, may be too "
            "rare for a pilot to meet"
        )
    if settings.noise_threshold is not None:
        return "every bounce: a noise threshold leaves no room for anything else"
    if not FEWEST_PIXELS <= size[0] * size[1] <= MOST_PIXELS:
        return f"every bounce: pilots are for {FEWEST_PIXELS} to {MOST_PIXELS} pixels"
    most = settings.max_spp
    few = min(settings.pilot, settings.pilot if most is None else most // (1 + settings.unbiased))
    if few < FEWEST_SAMPLES:
        return f"every bounce: under {FEWEST_SAMPLES} samples a pixel a pilot tells too little"
    return None


class Pilot:
    """The first round of a run, with the light separated by bounces.

    ``steps`` draws it for the sampler of the run, as it would be drawn without a plan. After the
    sampler's first decision, ``settle`` decides what is cut.

    Parameters
    ----------
    plan
        The plan by the scene alone.
    renderer
        Draws the samples. It is left set up for the plan.
    sampler
        The sampler of the run, without any samples.

    Attributes
    ----------
    plan, sampler
        Those given, until ``settle``. With a cut the sampler is another one, which has the pilot's
        samples without what is cut, and continues as if the scene had never asked for more.
    """

    def __init__(self, plan: Plan, renderer: MitsubaRenderer, sampler: Sampler) -> None:
        self.plan = plan
        self.sampler = sampler
        self._renderer = renderer
        self._metric = sampler.metric
        self._tolerance = sampler.settings.tolerance
        self._depth = renderer.needs.max_depth
        # The depth of a possible cut, and the share of all segments that it leaves.
        self._cut: int | None = None
        self._cost = 1.0
        self._held: list[Bounced] = []

    def steps(self) -> Iterator[int]:
        """Draw the round in parts; yield the number of samples of each."""
        self._glance()
        yield 0
        request = self.sampler.ask()
        assert request is not None
        for part in request.parts(AT_ONCE):
            self.sampler.tell(self._drawn(part))
            yield part.samples

    def _drawn(self, part: Request) -> Samples:
        """Draw a part, and keep its light with the cut, if there may be one."""
        which = part.pixels, part.first, part.count
        if self._cut is None:
            return self._renderer.sample(*which)
        found = self._renderer.sample_bounces(*which, self._cut)
        self._held.append(found)
        return found.samples

    def settle(self) -> None:
        """Decide on the cut, after the first decision of the sampler."""
        report, cut, held = self.sampler.report(), self._cut, self._held
        assert report is not None
        self._held = []
        if cut is None:
            return
        if report.forecast <= report.samples:
            self._keep("every bounce: the run is too short for a cut to save anything")
            return
        short = Sampler(self._renderer.size, self._metric, self.sampler.settings)
        rest = Statistics(report.jnd.size, halves=False)
        for samples, within, _ in held:
            short.tell(Samples(samples.pixels, within))
            rest.add(Samples(samples.pixels, samples.radiance - within))
        self._judge(cut, short, self.sampler.largest_without(rest))

    def _glance(self) -> None:
        """Find a cut that may save something and may not show, by one sample of some pixels.

        The mean of the picture alone must not show it: no difference is less than that of the mean.
        """
        pixels = np.arange(math.prod(self._renderer.size))
        # Packets of neighbouring pixels, as they are drawn.
        pixels = pixels[pixels // LANES % max(len(pixels) // GLANCED, 1) == 0]
        ones, most = np.ones_like(pixels), SHARE * self._tolerance / LOCAL
        reason = "every bounce: paths end early by themselves, and a cut would save too little"
        for cut in CUTS:
            if self._depth is not None and cut >= self._depth:
                break
            found = self._renderer.sample_bounces(pixels, 0 * ones, ones, cut)
            self._cost = _cost(found.segments, cut)
            if self._cost > WORTH:
                break
            shown = self._of_means(_mean(found.samples.radiance), _mean(found.within))
            if shown > most:
                reason = (
                    f"every bounce: without paths of more than {cut} segments the mean of the "
                    f"picture alone would differ by {shown:.2g} JND, of {most:.2g} that may be"
                )
            elif self._cost * _dearer(shown / self._tolerance) <= WORTH:
                self._cut = cut
                break
        if self._cut is None:
            self._keep(reason)
        if self._renderer.aov_sums is not None:
            self._renderer.aov_sums[:] = 0.0

    def _of_means(self, whole: NDArray[np.float64], part: NDArray[np.float64]) -> float:
        """Return the visible difference of two uniform pictures, of one pixel each."""
        pair = (torch.from_numpy(mean).reshape(1, 3, 1, 1) for mean in (whole, part))
        with torch.no_grad():
            return float(self._metric(*pair).amax())

    def _judge(self, cut: int, short: Sampler, bound: float) -> None:
        """Decide on a cut that shows by at most ``bound`` JND."""
        tolerance, most, cost = self._tolerance, SHARE * self._tolerance, self._cost
        evidence = {
            "segments": cut,
            "left_out_jnd": bound,
            "left_out_jnd_most": most,
            "share_of_segments": cost,
            "samples_per_pixel": short.settings.pilot,
        }
        self.plan = replace(self.plan, evidence=evidence)
        if bound > most:
            self._keep(
                f"every bounce: without paths of more than {cut} segments {bound:.2g} JND may be "
                f"missing, of {most:.2g} that may be"
            )
        elif cost * _dearer(bound / tolerance) > WORTH:
            self._keep(
                f"every bounce: paths of at most {cut} segments would cost {cost:.0%}, and the "
                f"{bound:.2g} JND that may be missing more samples than that saves"
            )
        else:
            left = (
                f"paths of more than {cut} segments: at most {bound:.2g} JND, of which the noise "
                "gets nothing"
            )
            self.plan = replace(
                self.plan,
                integrator=PATH,
                max_depth=cut,
                bound=bound,
                left_out=(*self.plan.left_out, left),
            )
            short.settings = replace(short.settings, tolerance=tolerance - bound)
            self.sampler = short
            self._renderer.simulate(cut)

    def _keep(self, reason: str) -> None:
        self.plan = replace(self.plan, kept=(*self.plan.kept, reason))


def _mean(light: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mean (3,) of the finite samples."""
    finite = light[np.isfinite(light).all(1)]
    mean: NDArray[np.float64] = finite.sum(0, dtype=np.float64) / max(len(finite), 1)
    return mean


def _cost(segments: NDArray[np.float32], cut: int) -> float:
    """Return the share of all segments that are followed with a cut.

    It is a count, not a time: the same run must decide the same.
    """
    packets = np.pad(segments, (0, -len(segments) % LANES)).reshape(-1, LANES).max(1)
    return float(np.minimum(packets, cut).sum() / max(float(packets.sum()), 1.0))


def _dearer(share: float) -> float:
    """Return the factor on the samples where noise may not use a share of the tolerance."""
    return math.inf if share >= 1.0 else (1.0 - share) ** -STEEP
