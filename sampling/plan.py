"""Which effects of a scene are simulated: those that it needs and that anyone could see.

First the scene is read: without media no volumetric integrator is needed, and where no surface
scatters, no light has been reflected twice. Then a pilot measures what each further bounce of light
adds, and the metric judges whether anyone could see it. What is left out has a bound in JND, and
the noise may use only the rest of the tolerance: both together stay within it. The pilot also
measures whether rays aimed at lights alone, or rays that materials scatter alone, would do with
less work than both, which gives the same picture with other noise.

The pilot is the first round of the run, and its samples stay in the picture. Where nothing is left
out, the picture is that of ``--effects full``, bit for bit; where paths are cut, it is that of a
scene that asks for no longer ones.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from sampling.renderers import Samples
from sampling.renderers.bounces import BOTH, LIGHTS, MATERIALS
from sampling.renderers.mitsuba import Bounced, MitsubaRenderer
from sampling.renderers.needs import PATH, Needs
from sampling.sampler import Report, Request, Sampler, Settings
from sampling.statistics import Statistics

# The values of `effects`.
AUTO, FULL = "auto", "full"

# Largest share of the tolerance that what is left out may use. Status: choice.
SHARE = 0.25

# Depths at which paths may be cut, in segments. Status: choice.
CUTS = (2, 3, 4, 6, 8, 12)

# Fewest samples per pixel from which a pilot can tell anything. Fewest pixels, because its code
# takes a quarter of a second to compile, and most pixels, because it is kept in memory, 768 bytes
# each. Status: choices.
FEWEST_SAMPLES, FEWEST_PIXELS, MOST_PIXELS = 16, 2**18, 2**20

# Before the pilot, two samples each of about so many pixels tell whether a cut could save anything
# and would not obviously show. The mean of the picture decides that, with a factor because some
# places differ more. Status: choice; a bound was 4 to 10 times the mean's difference on dim rooms
# and open scenes.
GLANCED, LOCAL = 2**13, 4.0

# The samples grow with this power of one over the tolerance. Status: measured, the Cornell box from
# 2 to 1 JND, 249 and 1,200 samples per pixel.
STEEP = 2.3

# The rest must cost at most this share, or everything is kept. Status: choice.
WORTH = 0.95

# Lights or materials alone must cost at most this share of both, of a whole run. Status: choice.
WORTH_ALONE = 0.9

# Standard deviation of a sample, of its mean, that is added to all noise before noises are
# compared: what less of it does is not seen, and may not decide. Status: choice.
FAINT = 0.01

# How light is found, in words.
WORDS = {
    BOTH: "rays aimed at lights and rays that materials scatter",
    LIGHTS: "rays aimed at lights",
    MATERIALS: "rays that materials scatter",
}

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
    found_by: str = BOTH
    """What finds light: `BOTH`, `LIGHTS` or `MATERIALS`; the last two with ``integrator`` alone."""

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
            "light_found_by": self.found_by,
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
    lit = needs.scatters or needs.passes or needs.unread
    if needs.max_depth is not None and (needs.max_depth < CUTS[0] or not lit):
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
    """The first round of a run, with the light separated by bounces and by what finds it.

    ``steps`` draws it for the sampler of the run, as it would be drawn without a plan. After the
    sampler's first decision, ``settle`` decides what is cut, and what finds light.

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
        Those given, until ``settle``. Where less is to be simulated the sampler is another one,
        which has the pilot's samples as they then are, and continues as if the run had begun so.
    """

    def __init__(self, plan: Plan, renderer: MitsubaRenderer, sampler: Sampler) -> None:
        self.plan = plan
        self.sampler = sampler
        self._renderer = renderer
        self._metric = sampler.metric
        self._tolerance = sampler.settings.tolerance
        needs = renderer.needs
        self._depth = needs.max_depth
        self._ways = (BOTH, LIGHTS) if needs.sharp_lights else (BOTH, LIGHTS, MATERIALS)
        # The depth of a possible cut, what may find light, and the share of all rays that is left
        # with the cut, by what finds light.
        self._cut: int | None = None
        self._found_by = BOTH
        self._rays = dict.fromkeys(self._ways, 1.0)
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
        """Draw a part, and keep what its light would be, if it may be simulated otherwise."""
        which = part.pixels, part.first, part.count
        if self._cut is None and self._found_by == BOTH:
            return self._renderer.sample(*which)
        found = self._renderer.sample_bounces(*which, self._cut, self._found_by)
        self._held.append(found)
        return found.samples

    def settle(self, look: Callable[[], None] = lambda: None) -> None:
        """Decide on the cut and on what finds light, after the first decision of the sampler.

        ``look`` is called before each long piece of work; what it raises ends the decision.
        """
        report, held = self.sampler.report(), self._held
        assert report is not None
        self._held = []
        if not held:
            return
        if report.forecast <= report.samples:
            self._keep("every bounce, and all rays: the run is too short to save anything")
            return
        cut, found_by, bound = self._cut, self._found_by, 0.0
        if cut is not None:
            rest = Statistics(report.jnd.size, halves=False)
            for samples, within, *_ in held:
                look()
                rest.add(Samples(samples.pixels, samples.radiance - within))
            bound = self.sampler.largest_without(rest, look)
            if not self._may_be_missing(cut, bound):
                return
        chosen = self._of([each.within for each in held], held, look)
        times = 1.0
        if found_by != BOTH:
            alone = self._of([each.alone for each in held], held, look)
            times = self._times_the_samples(chosen, alone, held)
            found_by = self._paying(found_by, times, report)
            if found_by != BOTH:
                chosen = alone
            else:
                times = 1.0
        look()
        cost = times * self._rays[found_by] * _dearer(bound / self._tolerance)
        if cost <= WORTH:
            self._simulate(cut, found_by, bound, chosen)
        elif cut is not None:
            self._keep(
                f"every bounce: paths of at most {cut} segments would cost "
                f"{self._rays[found_by]:.0%}, and the {bound:.2g} JND that may be missing more "
                "samples than that saves"
            )

    def _of(
        self,
        light: list[NDArray[np.float32]],
        held: list[Bounced],
        look: Callable[[], None],
    ) -> Sampler:
        """Return a sampler that has the pilot's samples with other light."""
        sampler = Sampler(self._renderer.size, self._metric, self.sampler.settings)
        for each, radiance in zip(held, light, strict=True):
            look()
            sampler.tell(Samples(each.samples.pixels, radiance))
        return sampler

    def _glance(self) -> None:
        """Find what may save something and may not show, by two samples of some pixels.

        The mean of the picture alone must not show a cut: no difference is less than that of the
        mean.
        """
        pixels = np.arange(math.prod(self._renderer.size))
        # Packets of neighbouring pixels, as they are drawn.
        pixels = pixels[pixels // LANES % max(len(pixels) // GLANCED, 1) == 0]
        twice, most = np.full_like(pixels, 2), SHARE * self._tolerance / LOCAL
        reason = "every bounce: paths end early by themselves, and a cut would save too little"

        def drawn(cut: int | None) -> tuple[Bounced, dict[str, float], str, float]:
            """Return samples, the shares of rays, the way with the least cost, and that cost."""
            found = self._renderer.sample_bounces(pixels, 0 * twice, twice, cut)
            rays = {way: _cost(found.rays_within[way], found.rays) for way in self._ways}
            costs = {way: rays[way] * _glanced_noise(found, way) for way in self._ways}
            way = min(costs, key=costs.__getitem__)
            if not costs[way] <= WORTH_ALONE * costs[BOTH]:
                way = BOTH
            return found, rays, way, costs[way]

        _, self._rays, self._found_by, whole = drawn(None)
        for cut in CUTS:
            if self._depth is not None and cut >= self._depth:
                break
            found, rays, way, cost = drawn(cut)
            if not cost <= WORTH * whole:
                break
            shown = self._of_means(_mean(found.samples.radiance), _mean(found.within))
            if shown > most:
                reason = (
                    f"every bounce: without paths of more than {cut} segments the mean of the "
                    f"picture alone would differ by {shown:.2g} JND, of {most:.2g} that may be"
                )
            elif cost * _dearer(shown / self._tolerance) <= WORTH * whole:
                self._cut, self._found_by, self._rays = cut, way, rays
                break
        if self._cut is None:
            self._keep(reason)
        if self._found_by == BOTH:
            self._keep(f"{WORDS[BOTH]}: neither alone would find light with less work")
        if self._renderer.aov_sums is not None:
            self._renderer.aov_sums[:] = 0.0

    def _of_means(self, whole: NDArray[np.float64], part: NDArray[np.float64]) -> float:
        """Return the visible difference of two uniform pictures, of one pixel each."""
        pair = (torch.from_numpy(mean).reshape(1, 3, 1, 1) for mean in (whole, part))
        with torch.no_grad():
            return float(self._metric(*pair).amax())

    def _may_be_missing(self, cut: int, bound: float) -> bool:
        """Decide whether what a cut leaves out, at most ``bound`` JND, may be missing."""
        most = SHARE * self._tolerance
        self._measured(
            segments=cut,
            left_out_jnd=bound,
            left_out_jnd_most=most,
            share_of_rays=self._rays[BOTH],
            samples_per_pixel=self.sampler.settings.pilot,
        )
        if bound > most:
            self._keep(
                f"every bounce: without paths of more than {cut} segments {bound:.2g} JND may be "
                f"missing, of {most:.2g} that may be"
            )
        return bound <= most

    def _times_the_samples(self, both: Sampler, alone: Sampler, held: list[Bounced]) -> float:
        """Return how many times the samples light needs that is found in one way alone.

        Each pixel weighs as many samples as the first decision wants of it, and needs them in
        proportion to its variance. That of the one way is told in two ways, of which the worse
        counts: by its own samples, and by the moments that both kinds of rays give, which know of
        light that its own samples have not met yet.
        """
        request = self.sampler.ask()
        assert request is not None
        wanted = np.full(self.sampler.count.size, self.sampler.settings.pilot, np.float64)
        wanted[request.pixels] = request.first + request.count
        count = np.maximum(both.count.reshape(-1), 1)
        excess = np.zeros(len(wanted))
        for each in held:
            told = each.excess[self._found_by]
            excess += np.bincount(each.samples.pixels, told, len(wanted))
        variance, of_alone = (each.single_variance.sum(-1).reshape(-1) for each in (both, alone))
        faint = (FAINT**2 * both.image**2).sum(-1).reshape(-1)
        return max(
            _noisier(variance, variance + excess / count, faint, wanted),
            _noisier(variance, of_alone, faint, wanted),
        )

    def _paying(self, found_by: str, times: float, report: Report) -> str:
        """Return what is to find light, if one way alone needs so many times the samples.

        The pilot is drawn already: what is left of the run must save as much as is wanted of all.
        """
        rays = self._rays[found_by] / self._rays[BOTH]
        most, left = self.sampler.settings.max_spp, report.forecast
        if most is not None:
            left = min(left, most * report.jnd.size - report.samples)
        share = left / (report.samples + left)
        self._measured(
            light_considered=found_by,
            times_the_samples=times if math.isfinite(times) else None,
            rays_of_those_of_both=rays,
        )
        if (1.0 - times * rays) * share >= 1.0 - WORTH_ALONE:
            return found_by
        self._keep(
            f"{WORDS[BOTH]}: {WORDS[found_by]} alone would need {times:.2g} times the samples, of "
            f"{rays:.0%} of the rays, in the {share:.0%} of the run that is left"
        )
        return BOTH

    def _simulate(self, cut: int | None, found_by: str, bound: float, chosen: Sampler) -> None:
        """Adopt what is to be simulated, and the sampler that has the pilot's samples so."""
        left = list(self.plan.left_out)
        if cut is not None:
            left.append(
                f"paths of more than {cut} segments: at most {bound:.2g} JND, of which the noise "
                "gets nothing"
            )
        if found_by != BOTH:
            other = MATERIALS if found_by == LIGHTS else LIGHTS
            times = self.plan.evidence["times_the_samples"]
            left.append(
                f"{WORDS[other]} to find light: {WORDS[found_by]} alone give the same picture, "
                f"with {times:.2g} times the samples and "
                f"{self._rays[found_by] / self._rays[BOTH]:.0%} of the rays"
            )
        depth = self._depth if cut is None else cut
        self.plan = replace(
            self.plan,
            integrator=PATH,
            max_depth=depth,
            bound=bound,
            left_out=tuple(left),
            found_by=found_by,
        )
        chosen.settings = replace(chosen.settings, tolerance=self._tolerance - bound)
        self.sampler = chosen
        self._renderer.simulate(depth, found_by)

    def _measured(self, **figures: Any) -> None:
        self.plan = replace(self.plan, evidence=self.plan.evidence | figures)

    def _keep(self, reason: str) -> None:
        self.plan = replace(self.plan, kept=(*self.plan.kept, reason))


def _mean(light: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mean (3,) of the finite samples."""
    finite = light[np.isfinite(light).all(1)]
    mean: NDArray[np.float64] = finite.sum(0, dtype=np.float64) / max(len(finite), 1)
    return mean


def _cost(part: NDArray[np.float32], rays: NDArray[np.float32]) -> float:
    """Return the share of all rays that is traced where each sample traces a part of them.

    It is a count, not a time: the same run must decide the same.
    """
    packets = (
        np.pad(each, (0, -len(each) % LANES)).reshape(-1, LANES).max(1).sum(dtype=np.float64)
        for each in (part, rays)
    )
    most, all_rays = packets
    return float(most / max(all_rays, 1.0))


def _glanced_noise(found: Bounced, found_by: str) -> float:
    """Return about how many times the samples ``found_by`` needs, by two samples of each pixel.

    Neighbours in a packet are taken together.
    """
    if found_by == BOTH:
        return 1.0
    light = found.within.reshape(-1, 2, 3).astype(np.float64)
    variance = (np.diff(light, axis=1) ** 2).sum((1, 2)) / 2.0
    excess = found.excess[found_by].reshape(-1, 2).mean(1, dtype=np.float64)
    faint = (FAINT**2 * light.mean(1) ** 2).sum(1)
    own, more, faint = (
        np.pad(each, (0, -len(each) % LANES)).reshape(-1, LANES).sum(1)
        for each in (variance, excess, faint)
    )
    return _noisier(own, own + more, faint, np.ones_like(own))


def _noisier(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    faint: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> float:
    """Return the weighted mean of the ratio of two variances, each with a ``faint`` one added."""
    before, after = before + faint, after + faint
    dark = before <= 0.0
    ratio = np.where(dark, np.where(after > 0.0, np.inf, 1.0), after / np.where(dark, 1.0, before))
    mean = float((weight * ratio).sum() / weight.sum())
    # Not each by itself: few samples may tell of less than no variance.
    return math.inf if math.isnan(mean) else max(mean, 0.0)


def _dearer(share: float) -> float:
    """Return the factor on the samples where noise may not use a share of the tolerance."""
    return math.inf if share >= 1.0 else (1.0 - share) ** -STEEP
