"""Where the next samples go ("determine next sample location", Fig. 8).

There are four strategies with one interface. Each says how many samples every pixel should have by
the end of the next round for the model to predict the tolerance; none decides when to stop.
"""

import math
from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from sampling.prediction import Model
from sampling.statistics import Statistics

Plane = NDArray[np.float64]

# A round multiplies no pixel's samples by more. Status: choice.
LARGEST_GROWTH = 64.0

# A round multiplies the samples of a pixel that it selects by no less. Status: choice.
SMALLEST_GROWTH = 1.05

# The search ends when the logarithm of the growth is known this well, or that of the prediction is
# less than this below the goal's: 1.6 % of the samples, 0.4 % of the JND. Status: choice.
CLOSE, CLOSE_BELOW = 0.016, 0.004

# The power of the samples with which the search begins: differences fall by the root. Status:
# choice.
FALLING = 0.5

# The smallest power that the search then assumes, since differences usually fall faster once all
# pixels of a largest one grow. Status: choice, measured.
SLOWEST = 0.125


class Strategy(Protocol):
    """Distributes the samples of a round."""

    @property
    def halves(self) -> bool:
        """Whether it needs the mean of every second sample."""

    def wanted(self, model: Model, statistics: Statistics, goal: float) -> Plane:
        """Return how many samples every pixel should have, (H, W), at least what it has.

        Parameters
        ----------
        model
            The model of the samples so far.
        statistics
            The samples so far.
        goal
            The value wanted of `Model.largest`, which stands for the largest total error of the
            boundary images, in JND to the power of the summation exponent.
        """


class Perceptual:
    """The paper's: more samples below the nodes whose total is over the tolerance.

    A total over the tolerance is the sum of errors down a path and, by pooling, of neighbours, so
    it is traced back to the pixels whose noise causes it. Where every pixel's samples are in
    proportion to its share, no other distribution of as many samples does better. A round goes half
    way there in the logarithm, because the shares of what it improves will fall.
    """

    halves = False

    def wanted(self, model: Model, statistics: Statistics, goal: float) -> Plane:
        """Find the smallest growth along the shares at which the model predicts the goal."""
        del statistics
        worth = np.sqrt(model.shares() / model.count)
        worth /= max(float(worth.max()), 1e-300)
        return _grown(model, worth, _growth(model, worth, goal))


class _Levelled(ABC):
    """Evens out an error that falls as one over the samples, down to one level for all pixels."""

    halves = False

    @abstractmethod
    def error(self, model: Model, statistics: Statistics) -> Plane:
        """Return the error of every pixel, (H, W), not negative."""

    def wanted(self, model: Model, statistics: Statistics, goal: float) -> Plane:
        """Find the highest level of error at which the model predicts the goal."""
        # A pixel without a finite sample is taken as known: it must not set the level.
        growth = self.error(model, statistics) * (statistics.count > 0).reshape(model.size)
        growth = growth / max(float(growth.max()), 1e-300)
        return _grown(model, growth, _growth(model, growth, goal))


class Uniform(_Levelled):
    """The same number of samples for every pixel."""

    def error(self, model: Model, statistics: Statistics) -> Plane:
        """Return one over the samples."""
        del statistics
        return 1.0 / model.count


class Objective(_Levelled):
    """The paper's Eq. 6: the variance of the mean, summed over R, G, B.

    The detail coefficients have a quarter of their pixels' variance in every orientation, so the
    largest local error lies where the variance is largest.
    """

    def error(self, model: Model, statistics: Statistics) -> Plane:
        """Return s^2 / n with the shrunk variance: a pixel's own, once 0, would stay 0."""
        del statistics
        error: Plane = (model.single[0] + model.single[3] + model.single[5]) / model.count
        return error


class HalfBuffer(_Levelled):
    """What Cycles and OpenMoonRay do: the image against the image of every second sample.

    The error is sum abs(I - I_half) / sqrt(sum I), its maximum over 3x3 pixels; its square falls as
    one over the samples.
    """

    halves = True

    def noise(self, statistics: Statistics, size: tuple[int, int]) -> Plane:
        """Return the error of every pixel in its own unit, (H, W)."""
        if statistics.half_mean is None:
            raise ValueError("expected statistics with halves")
        distance = np.abs(statistics.mean - statistics.half_mean).sum(0)
        light = np.maximum(statistics.mean.sum(0), 0.0)
        error = distance / np.sqrt(np.maximum(light, DARKEST))
        plane = torch.from_numpy(error.reshape(1, 1, *size))
        found: Plane = functional.max_pool2d(plane, 3, 1, 1)[0, 0].numpy()
        return found

    def error(self, model: Model, statistics: Statistics) -> Plane:
        """Return the square of the noise."""
        return self.noise(statistics, model.size) ** 2


# The half-buffer divides by no less light than this. Status: choice.
DARKEST = 1e-4

STRATEGIES: dict[str, Strategy] = {
    "perceptual": Perceptual(),
    "objective": Objective(),
    "uniform": Uniform(),
    "halfbuffer": HalfBuffer(),
}


def _grown(model: Model, worth: Plane, growth: float) -> Plane:
    """Return the samples of every pixel, (H, W), those of largest worth times exp(growth)."""
    count: Plane = model.count * np.maximum(worth * np.exp(growth), 1.0)
    return count


def _growth(model: Model, worth: Plane, goal: float) -> float:
    """Return about the smallest logarithm of the growth at which the model predicts the goal.

    It lies between `SMALLEST_GROWTH` and `LARGEST_GROWTH`. The totals fall as samples grow: their
    logarithm is interpolated between a growth that is too small and one that is enough; where that
    does not halve the bracket, its middle is taken.
    """
    smallest, largest = math.log(SMALLEST_GROWTH), math.log(LARGEST_GROWTH)

    def over(count: Plane | None) -> float:
        """Return the logarithm of the largest difference over the goal's, by `Model.largest`."""
        return math.log(max(model.largest(count) / goal, 1e-300)) / model.exponent

    little, above = 0.0, over(None)
    if above <= 0.0:
        return smallest
    enough, below = largest, math.nan  # the largest growth has not been tried yet
    place = above / FALLING
    while enough - little > CLOSE:
        between, margin = enough - little, 0.0 if math.isnan(below) else 0.5 * CLOSE
        place = min(max(place, little + 0.5 * CLOSE), enough - margin)
        found = over(_grown(model, worth, place))
        if found > 0.0:
            falling = max((above - found) / (place - little), SLOWEST)
            little, above = place, found
            # Forward, and a little too far, so that the next step is enough.
            place += 1.5 * found / falling
        else:
            enough, below = place, found
            if below > -CLOSE_BELOW:
                break
        if not math.isnan(below):
            share = (above + 0.5 * CLOSE_BELOW) / (above - below)
            share = 0.5 if enough - little > 0.5 * between else share
            place = little + share * (enough - little)
    return max(enough, smallest)
