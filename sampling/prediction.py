"""Predictions of the visible difference between the current image and the converged one.

There are two, from one set of statistics. *Boundary images* (the paper's) locate the error: they
place samples. *Simulation* estimates its maximum: it decides when to stop.
"""

import math
from collections.abc import Callable
from functools import cached_property, partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from sampling.boundary import LARGEST, NONE, detail_variances
from sampling.error import maximum, total
from sampling.statistics import FIRST, SECOND, Statistics
from sampling.tiles import LocalErrors, local_errors
from sampling.variance import pooled_covariance
from torch_vdm import VDM
from torch_vdm.model.cortex import Cortex
from torch_vdm.model.grid import Grid
from torch_vdm.model.matrix import mix

# Images simulated for one prediction: as many as have `SIMULATED` pixels in total. The maximum of
# a small image scatters more (10 to 20 % at 32x32, 5 % at 128x128), so more images are needed to
# know its mean to 2 %. Status: choice, measured.
FEWEST_DRAWS, MOST_DRAWS, SIMULATED = 16, 64, 2**18

# The predicted maximum lies `QUANTILE` standard deviations above the mean of the simulated maxima.
# The variance is theirs plus that of the prediction's error, `INEXACT` of the mean. The first is
# where 99 % of simulated maxima lie (they are skewed: 97 % at 1.8 to 2.3, by scene), the second is
# half of the model's largest error on the safe side.
# Status: fitted to the honest stop, see docs/sampling.md.
QUANTILE, INEXACT = 2.5, 0.03

# Exponent of the power sum of differences that replaces a maximum where a derivative is needed.
# Status: choice, measured.
SHARPNESS = 10.0

# Exponent of the power sum that replaces the maximum of differences that scatter. The maximum of
# many values with a power-law tail of this exponent scatters by 1.28 over the exponent; that of
# differences scatters by 5 to 10 %. Status: derived, rounded.
SOFTNESS = 20.0

# Share of the samples that is spread evenly over all pixels that have shown noise, whatever the
# model predicts for them: it is sometimes wrong, and a pixel without samples cannot show it.
# Status: choice, measured, of 0, 0.05, 0.1, 0.2, 0.33.
EVEN = 0.05

# How many times its variance the square of a single detail must be to count as a detail: for
# placing samples, by the image as plain as it may be, and for the simulation that decides to stop.
# Status: choices, measured, see docs/sampling.md.
PLACING_DOUBT, STOPPING_DOUBT = 9.0, 4.0

# Nodes on each side over which the simulated totals are averaged. Status: choice.
SURROUNDINGS = 2

# Values of simulated planes that are computed at once. Status: choice.
AT_ONCE = 2**18


class Model:
    """The statistics of a round, as the metric sees them.

    Where all samples are grey, it computes with one plane (C = 1) in place of S, M and L (C = 3),
    which changes results by rounding only.

    Parameters
    ----------
    metric
        The metric that judges.
    statistics
        Statistics of the samples so far.
    size
        Height and width.
    look
        Called before each long piece of work; it may raise to end the work early.
    grey
        Whether all samples are grey; None: as the statistics say.
    """

    def __init__(
        self,
        metric: VDM,
        statistics: Statistics,
        size: tuple[int, int],
        look: Callable[[], None] = lambda: None,
        grey: bool | None = None,
    ) -> None:
        self.metric = metric
        self._look = look
        self.size = size
        self.count = np.maximum(statistics.count, 1).reshape(size)
        # Nothing is known of a pixel without a finite sample, and more samples will not help.
        seen = (statistics.count > 0).reshape(size)
        self.single = pooled_covariance(statistics, size) * seen
        # Where samples have differed.
        self.noisy = (statistics.comoments[FIRST == SECOND] > 0.0).any(0).reshape(size)
        self.mean = torch.from_numpy(statistics.mean.reshape(1, 3, *size))
        self.true_means = metric.observer.true_means
        self.exponent = metric.observer.summation_exponent
        self.grey = statistics.grey() if grey is None else grey
        # From samples to the planes that are compared, (C, 3).
        self.to_cones = _first_channel() if self.grey else _to_cones(metric)
        # The variance of a single sample, and of their mean.
        self.single_variance = self._cone_variance()
        self.variance = self.single_variance / torch.from_numpy(self.count)
        # Factor on the totals of the boundary images, once there are simulated ones to compare.
        self.correction: Tensor | None = None
        # Variances of the details, which are estimated from them in single precision.
        self.details = detail_variances(self.variance.float(), self.true_means)
        with torch.no_grad():
            self.cortex = self._lit(metric.represent(self.mean, self.grey))
        self.truth = self._estimated(partial(_shrunk, doubt=PLACING_DOUBT))

    def totals(self, count: NDArray[np.float64] | None = None) -> Tensor:
        """Return the total error of the finest nodes by the boundary images, (1, 1, h, w).

        It is in JND to the power of the summation exponent. With ``count``, (H, W), it is what the
        error would be if each pixel had that many samples.
        """
        with torch.no_grad():
            return self._corrected(self._now if count is None else self._uncorrected(count))

    @cached_property
    def _now(self) -> Tensor:
        """The totals for the samples so far, by the boundary images without correction."""
        self._look()
        return _finest(self.errors.own, self.cortex.grid)

    def _uncorrected(self, count: NDArray[np.float64]) -> Tensor:
        self._look()
        return _finest(self.errors.at(self.leaves(count)), self.cortex.grid)

    def largest(self, count: NDArray[np.float64] | None = None) -> float:
        """Return a soft maximum of the `totals`, which scatter within a run.

        It is the root of the sum of the differences to the power of `SOFTNESS`: it falls little
        where the highest totals fall and others that are nearly as high stay.
        """
        totals = self.totals(count)
        most = float(totals.amax())
        if most <= 0.0:
            return 0.0
        power = SOFTNESS / self.exponent
        return most * math.pow(float(((totals / most) ** power).sum()), 1.0 / power)

    def leaves(self, count: NDArray[np.float64] | None = None) -> Tensor:
        """Return the variance of each pixel for `errors`, (1, C, H, W), in single precision.

        With ``count``, (H, W), it is what the variance would be if each pixel had that many
        samples.
        """
        samples = torch.from_numpy(self.count if count is None else count)
        return self.single_variance.float() / samples.float()

    @cached_property
    def errors(self) -> LocalErrors:
        """The local errors of the boundary images for any number of samples."""
        with torch.no_grad():
            return LocalErrors(self.metric, self.truth, self.leaves())

    @cached_property
    def textured(self) -> Cortex:
        """The image as textured as it may be; `truth` is the one as plain as it may be."""
        return self._estimated(_textured)

    def _lit(self, cortex: Cortex) -> Cortex:
        """Return the image with its noise added to the adapting light, in the mean square.

        Boundary images and simulated ones are compared at this adaptation. On black the former have
        no light to adapt to, so the eye would be blind to their noise; the latter have some, next
        to none in places, so it would see all of it.
        """
        lit = tuple(
            torch.hypot(window, variance.mean(2).sqrt().to(window))
            for window, variance in zip(cortex.windows or (), self.details, strict=True)
        )
        return cortex._replace(windows=lit or None)

    def _estimated(self, estimate: Callable[[Tensor, Tensor], Tensor]) -> Cortex:
        """Return the image with details estimated from its own and their variances."""
        most = math.sqrt(LARGEST)
        own = (detail.clamp(-most, most).float() for detail in self.cortex.details)
        details = map(estimate, own, self.details)
        return self.cortex._replace(details=tuple(details))

    def shares(self) -> NDArray[np.float64]:
        """Return the share of the samples that each pixel should have, (H, W), not negative.

        It is how much the pixel's noise adds to the largest totals, averaged over the image as
        plain and as textured as it may be. A share `EVEN` is divided among all noisy pixels.
        """
        found = self._slopes(self.truth, self.textured)
        noisy = torch.from_numpy(self.noisy.astype(np.float64))[None, None]
        # And around them: not only where samples happened to hit.
        even = functional.max_pool2d(noisy, 2 * SURROUNDINGS + 1, 1, SURROUNDINGS)[0, 0]
        even = even / even.sum().clamp_min(1.0)
        shares: NDArray[np.float64] = ((1.0 - EVEN) * found + EVEN * even).numpy()
        return shares

    def _slopes(self, *truths: Cortex) -> Tensor:
        """Return minus the derivative of a power sum of the totals, of exponent `SHARPNESS`.

        It is by the logarithm of each pixel's samples, (H, W), not negative, normalized to a sum of
        1 and averaged over the images, in single precision.
        """
        batch = truths[0].each(lambda *planes: torch.cat(planes).float(), *truths[1:])
        logarithm = torch.zeros(len(truths), 1, *self.size, requires_grad=True)
        totals = self._totals(self.variance.float() * torch.exp(-logarithm), batch)
        largest = totals.detach().amax((1, 2, 3), keepdim=True).clamp_min(1e-300)
        power = SHARPNESS / self.exponent
        (gradient,) = torch.autograd.grad(((totals / largest) ** power).sum(), logarithm)
        slopes = gradient.double().neg().clamp_min(0.0)
        slopes = slopes / slopes.sum((1, 2, 3), keepdim=True).clamp_min(1e-300)
        return slopes.mean((0, 1))

    def _totals(self, variance: Tensor, truth: Cortex) -> Tensor:
        self._look()
        variances = detail_variances(variance, self.true_means)
        local = local_errors(self.metric, truth, variances, variance)
        return self._corrected(_finest(local, truth.grid))

    def _corrected(self, finest: Tensor) -> Tensor:
        return finest if self.correction is None else finest * self.correction

    @torch.no_grad()
    def simulated(
        self, draws: int | None = None, tolerance: float = math.inf
    ) -> NDArray[np.float64]:
        """Return the largest difference in each of ``draws`` simulated pairs of images, JND.

        The true details are taken to be the current ones, shrunk by the share of noise in them and
        among their neighbours. Noise of the estimated covariance is added to them to make the other
        image, and the eye is adapted to both alike. It is computed in single precision, because
        differences are known to some percent. A quarter of the draws, on the plain image, correct
        the boundary images; see `_correct`.

        Parameters
        ----------
        draws
            None: a number that depends on the size.
        tolerance
            In JND. Where a quarter of the draws lie above it on average, the rest is skipped: the
            run does not end yet, and only at the end must the prediction be good.
        """
        mixing = self._mixing(self.single)
        generator = torch.Generator().manual_seed(0)
        height, width = self.size
        if draws is None:
            draws = min(max(SIMULATED // (height * width), FEWEST_DRAWS), MOST_DRAWS)
        few = max(draws // 4, 2)
        step = min(max(1, AT_ONCE // (3 * height * width)), few)
        likely, plain = (
            self._judge(truth)
            for truth in (self._estimated(partial(_shrunk, doubt=STOPPING_DOUBT)), self.truth)
        )
        largest = np.empty(0)
        visible: list[Tensor] = []
        while len(largest) < draws and not (len(largest) >= few and largest.mean() > tolerance):
            self._look()
            batch = min(step, draws - len(largest))
            normal = torch.randn(batch, 3, height, width, generator=generator, dtype=torch.float32)
            noise = mix(mixing, normal[:, : len(mixing)])
            added = self.metric.transform.decompose(noise, true_means=self.true_means)
            # Samples are placed by the plain image, for which a quarter of the draws is enough.
            if len(largest) < few:
                visible.append(plain(added))
            totals = likely(added)
            found = totals.amax((1, 2, 3)).numpy() ** (1.0 / self.exponent)
            largest = np.append(largest, found)
        self._correct(torch.cat(visible).mean(0, keepdim=True))
        return largest

    @torch.no_grad()
    def largest_without(self, part: Statistics) -> float:
        """Return the visible difference that leaving out a part of the light makes, JND.

        The true one exceeds it in few runs, as with `predicted_maximum`. What is left out is
        simulated as the mean of its samples, plus noise of that mean's estimated covariance, which
        the mean already has once. It is subtracted from the image as plain as it may be, which
        masks least.

        Parameters
        ----------
        part
            Statistics of the part of each sample that is left out, of as many samples as
            ``statistics`` has.
        """
        mixing = self._mixing(pooled_covariance(part, self.size))
        mean = torch.from_numpy(part.mean.reshape(3, *self.size))
        known = torch.einsum("ij,jhw->ihw", self.to_cones, mean).float()
        generator = torch.Generator().manual_seed(0)
        seen = self._judge(self.truth)
        largest = np.empty(FEWEST_DRAWS)
        for number in range(FEWEST_DRAWS):
            self._look()
            normal = torch.randn(1, 3, *self.size, generator=generator, dtype=torch.float32)
            missing = known + mix(mixing, normal[:, : len(mixing)])
            totals = seen(self.metric.transform.decompose(-missing, true_means=self.true_means))
            largest[number] = float(totals.amax()) ** (1.0 / self.exponent)
        return _upper(largest)

    def _mixing(self, single: NDArray[np.float64]) -> Tensor:
        """Return the matrices from normal deviates to S, M, L, (C, C, H, W), float32.

        ``single``, (6, H, W): the covariance of single samples. The first deviate makes the noise
        of grey samples: the images are those that three planes would have.
        """
        factor = _factor(torch.from_numpy(single / self.count))
        mixing = torch.einsum("ij,jkhw->ikhw", self.to_cones, factor).float()
        return mixing[:, : len(mixing)].contiguous()

    def _judge(self, truth: Cortex) -> Callable[[Cortex], Tensor]:
        """Return a function that gives the totals, (B, 1, h, w), of noises added to an image."""
        first = truth.each(Tensor.float)
        compare = self.metric.beside(first)

        def seen(noise: Cortex) -> Tensor:
            details = tuple(map(torch.add, first.details, noise.details))
            return compare(first._replace(details=details, mean=first.mean + noise.mean)).double()

        return seen

    def _correct(self, visible: Tensor) -> None:
        """Make the boundary images agree with the simulated ones on where the error is.

        How the difference of a quartile of every detail relates to that of noise depends on masking
        and on colour: on a plain wall next to a chequered floor it was found half as large. So each
        node's total is multiplied by a ratio of means over its surroundings: that of the simulated
        totals over that of the boundary images' totals.
        """
        self.correction = None
        totals = self.totals()
        pooled, own = (
            functional.avg_pool2d(
                plane, 2 * SURROUNDINGS + 1, 1, SURROUNDINGS, count_include_pad=False
            )
            for plane in (visible, totals)
        )
        self.correction = pooled / own.clamp_min(1e-300)

    def predicted_maximum(self, tolerance: float = math.inf) -> float:
        """Return the visible difference that the true one exceeds in few runs, JND.

        It is less exact above ``tolerance``; see `simulated`.
        """
        return _upper(self.simulated(tolerance=tolerance))

    def _cone_variance(self) -> Tensor:
        """Return the variance of a single sample of each pixel in S, M, L, (1, C, H, W).

        It is clamped to `LARGEST`.
        """
        # The diagonal of M C M^T.
        matrix = self.to_cones.numpy()
        weights = matrix[:, FIRST] * matrix[:, SECOND] * np.where(FIRST == SECOND, 1.0, 2.0)
        variance = np.einsum("ck,khw->chw", weights, self.single)
        return torch.from_numpy(np.clip(variance, 0.0, LARGEST))[None]


def _upper(largest: NDArray[np.float64]) -> float:
    """Return a bound that the largest difference exceeds in few runs, from simulated ones."""
    mean = float(largest.mean())
    return mean + QUANTILE * math.hypot(float(largest.std(ddof=1)), INEXACT * mean)


def _finest(local: tuple[Tensor, ...], grid: Grid) -> Tensor:
    """Return the total errors of the finest nodes, (1, 1, h, w), float64."""
    return total(local, maximum(local, grid), grid)[-1].double()


def _to_cones(metric: VDM) -> Tensor:
    """Return the matrix from samples to S, M, L, (3, 3), float64."""
    cones = metric.get_buffer("cones").double().cpu()
    if metric.display.encoding == "xyz":
        return cones
    return cones @ metric.get_buffer("primaries").double().cpu() * metric.display.gain


def _first_channel() -> Tensor:
    """Return the matrix from grey samples to the one plane that stands for them, (1, 3)."""
    return torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)


def _shrunk(detail: Tensor, variance: Tensor, doubt: float) -> Tensor:
    """Return the details less the noise in them, d max(0, 1 - V / d^2), by two tests.

    One takes V and d^2 as means over 3x3 nodes, which detects a texture. Next to an edge that mean
    would keep the noise, so the detail by itself must pass too, against ``doubt`` variances.
    """
    power = detail * detail
    share = torch.maximum(
        _around(variance) / _around(power).clamp_min(NONE), doubt * variance / power.clamp_min(NONE)
    )
    return detail * (1.0 - share).clamp_min(0.0)


def _textured(detail: Tensor, variance: Tensor) -> Tensor:
    """Return the details at their likely size, where their neighbours show a texture.

    It is the root mean square of a normal detail given its observed value, never under `_shrunk`.
    The prior variance is the least mean over the four squares of 2x2 nodes around a node, less
    noise, all orientations together: the least, because a plain node next to an edge is no
    texture, and without the node itself, because noise must not mask itself.
    """
    power = detail * detail
    prior = _least(power - variance).clamp_min(0.0)
    keep = prior / (prior + variance).clamp_min(NONE)
    likely = (keep * (keep * power + variance)).sqrt()
    return torch.where(detail < 0.0, -1.0, 1.0) * torch.maximum(
        likely, _shrunk(detail, variance, PLACING_DOUBT).abs()
    )


def _least(energy: Tensor) -> Tensor:
    """Return the least mean over a node's 2x2 squares without itself, (B, C, 1, h, w).

    ``energy``, (B, C, 3, h, w), is averaged over the orientations; a node that is alone gives 0.
    """
    plane = energy.mean(2)
    size = (plane.shape[-2], plane.shape[-1])

    def squares(nodes: Tensor) -> Tensor:
        """Return the sums over all 2x2 squares that contain a node."""
        return functional.avg_pool2d(functional.pad(nodes, (1, 1, 1, 1)), 2, 1) * 4.0

    sums, counts = squares(plane), squares(torch.ones_like(plane[:1, :1])) - 1.0
    least = torch.full_like(plane, math.inf)
    for y in (0, 1):
        for x in (0, 1):
            window = (..., slice(y, y + size[0]), slice(x, x + size[1]))
            others = (sums[window] - plane) / counts[window].clamp_min(1.0)
            least = torch.where(counts[window] > 0.5, torch.minimum(least, others), least)
    return torch.where(least.isinf(), 0.0, least)[:, :, None]


def _around(plane: Tensor) -> Tensor:
    """Return the mean over 3x3 nodes of (B, C, 3, h, w); fewer at the border.

    The additions are those of `avg_pool2d`, bit for bit, in half of its time.
    """
    height, width = plane.shape[-2:]

    def sums(nodes: Tensor) -> Tensor:
        around = functional.pad(nodes, (1, 1, 1, 1))
        total = torch.zeros_like(nodes)
        for y in range(3):
            for x in range(3):
                total += around[..., y : y + height, x : x + width]
        return total

    return sums(plane) / sums(torch.ones_like(plane[0, 0, 0]))


def _factor(covariance: Tensor) -> Tensor:
    """Return the Cholesky factor of (6, H, W), which may be singular, as (3, 3, H, W)."""
    rr, rg, rb, gg, gb, bb = covariance
    a = rr.clamp_min(0.0).sqrt()
    over_a = torch.where(a > 0.0, 1.0 / torch.where(a > 0.0, a, 1.0), 0.0)
    b, c = rg * over_a, rb * over_a
    d = (gg - b * b).clamp_min(0.0).sqrt()
    # Not where that would divide by a remainder that is only rounding.
    over_d = torch.where(d * d > 1e-12 * gg, 1.0 / torch.where(d > 0.0, d, 1.0), 0.0)
    e = (gb - b * c) * over_d
    f = (bb - c * c - e * e).clamp_min(0.0).sqrt()
    zero = torch.zeros_like(a)
    return torch.stack(
        (torch.stack((a, zero, zero)), torch.stack((b, d, zero)), torch.stack((c, e, f)))
    )
