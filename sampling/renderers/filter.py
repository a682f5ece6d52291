"""Where in a pixel's neighbourhood a sample falls: filter importance sampling.

A film's reconstruction filter weights what a pixel sees around its centre, and Mitsuba's own
render adds each sample to every pixel within the filter's radius: neighbours share samples and
their noise. Here the place of each sample is drawn from the filter instead, so that the samples of
all pixels stay independent, as the statistics and denoisers assume; the expectation is the same
(Ernst, Stamminger and Greiner 2006).

Mitsuba's module is passed in: `sampling.renderers.mitsuba` alone imports it.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Mitsuba's filters by the names of their classes; the values are those of ``--filter``.
NAMES = {
    "BoxFilter": "box",
    "TentFilter": "tent",
    "GaussianFilter": "gaussian",
    "MitchellNetravaliFilter": "mitchell",
    "CatmullRomFilter": "catmullrom",
    "LanczosSincFilter": "lanczos",
}

# The filter that the scene's film has.
SCENE = "scene"

FILTERS = (SCENE, *NAMES.values())

# Pieces of a pixel, in each of which the filter is taken as linear; even, because the borders of
# pixels lie half a pixel from their centres. Status: choice; the densities of Mitsuba's filters
# are then off by at most 1e-4 of their peak.
PIECES = 64

# How far inside its radius, as a share of it, the end of a filter is evaluated: it may end in a
# step. Status: choice.
INSIDE = 1e-6

# The share of the filter's peak below which it is taken as 0: a sinc is not exactly 0 at integers
# in single precision. Status: choice.
NOTHING = 1e-6


class Place(NamedTuple):
    """Where in the film samples fall, in pixels from its crop's corner, and their weights."""

    x: Any
    y: Any
    weight: Any
    """1.0 for a filter without negative lobes."""


class PixelFilter:
    """A reconstruction filter from which the places of samples are drawn.

    A filter with negative lobes takes two rays per sample, with the same random numbers: the place
    of one is drawn from where the filter is positive, that of the other from where it is negative,
    and the second is subtracted. One ray with a random sign would add noise where the picture is
    uniform.

    At the film's border Mitsuba divides by the weights of what was sampled, and nothing is sampled
    outside the crop unless the film's ``sample_border`` is set: there the filter is truncated and
    renormalized.

    Parameters
    ----------
    mi, dr
        Mitsuba, with a variant set, and Dr.Jit.
    film
        The film; the filter is truncated at the border of its crop.
    rfilter
        The filter, separable as all of Mitsuba's are.

    Attributes
    ----------
    name
        One of `NAMES`, or the class of a filter that is not Mitsuba's.
    words
        Mitsuba's description of it, with its parameters.
    rays
        Rays per sample: 1, or 2 where the filter has negative lobes.
    """

    def __init__(self, mi: Any, dr: Any, film: Any, rfilter: Any) -> None:
        kind = rfilter.class_name()
        self.name: str = NAMES.get(kind, kind)
        self.words = " ".join(str(rfilter).split())
        self.rays = 1
        self._mi, self._dr = mi, dr
        # Uniform over the pixel, without a table.
        self._box: bool = self.name == "box" and rfilter.radius() == 0.5
        if self._box:
            return
        nodes, values = _linear_pieces(mi, rfilter)
        lobes = [np.maximum(values, 0.0), np.maximum(-values, 0.0)]
        self.rays = 2 if lobes[1].any() else 1
        self._lobes = [
            mi.IrregularContinuousDistribution(self._plane(nodes), self._plane(lobe))
            for lobe in lobes[: self.rays]
        ]
        self._area = [float(_area(nodes, lobe)[-1]) for lobe in lobes]
        cut = not film.sample_border()
        self._axes = [
            [
                tuple(self._plane(plane) for plane in _shares(nodes, lobe, int(length), cut))
                for lobe in lobes[: self.rays]
            ]
            for length in film.crop_size()
        ]

    def place(self, sampler: Any, x: Any, y: Any, negative: Any) -> Place:
        """Draw a place for each pixel.

        Parameters
        ----------
        sampler
            Returns the random numbers: two, preceded by one more where a sample takes two rays.
        x, y
            Column and row in the crop, integers of the variant.
        negative
            Whether the ray is the one to subtract; ignored where there is only one.
        """
        mi, dr = self._mi, self._dr
        if self._box:
            offset = sampler.next_2d()
            return Place(mi.Float(x) + offset.x, mi.Float(y) + offset.y, 1.0)
        columns, rows = (
            [tuple(self._at(plane, index) for plane in lobe) for lobe in axis]
            for axis, index in zip(self._axes, (x, y), strict=True)
        )
        centre_x, centre_y = mi.Float(x) + 0.5, mi.Float(y) + 0.5
        if self.rays == 1:
            offset = sampler.next_2d()
            place_x = centre_x + self._inside(0, columns, offset.x)
            return Place(place_x, centre_y + self._inside(0, rows, offset.y), 1.0)
        choice, offset = sampler.next_1d(), sampler.next_2d()
        areas = [
            [area * share for area, (_, share) in zip(self._area, lobes, strict=True)]
            for lobes in (columns, rows)
        ]
        (px, nx), (py, ny) = areas
        # The product is positive where both factors have the same sign, negative where they differ.
        one = px * dr.select(negative, ny, py)
        all_of_it = one + nx * dr.select(negative, py, ny)
        positive_x = choice * all_of_it < one
        positive_y = positive_x != negative
        weight = dr.select(negative, -all_of_it, all_of_it) / ((px - nx) * (py - ny))
        apart_x, apart_y = (
            dr.select(positive, self._inside(0, lobes, u), self._inside(1, lobes, u))
            for positive, lobes, u in (
                (positive_x, columns, offset.x),
                (positive_y, rows, offset.y),
            )
        )
        return Place(centre_x + apart_x, centre_y + apart_y, weight)

    def _inside(self, lobe: int, shares: Any, u: Any) -> Any:
        """Return the offset from the centre below which a share ``u`` of the cut lobe lies."""
        begin, share = shares[lobe]
        return self._lobes[lobe].sample(begin + u * share)

    def _plane(self, numbers: NDArray[np.float64]) -> Any:
        """Return numbers in the variant's type."""
        number = self._mi.Float
        return numbers.tolist() if number is float else number(numbers.astype(np.float32))

    def _at(self, plane: Any, index: Any) -> Any:
        if isinstance(plane, list):
            return plane[index]
        return self._dr.gather(self._mi.Float, plane, index)


def _linear_pieces(mi: Any, rfilter: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ends of a filter's linear pieces, its zeros included, and its values there."""
    radius = float(rfilter.radius())
    inner = np.arange(-int(radius * PIECES), int(radius * PIECES) + 1) / PIECES
    nodes = np.union1d(inner[np.abs(inner) < radius], [-radius, radius])
    values = _values(mi, rfilter, nodes * (1.0 - INSIDE))
    values[np.abs(values) < NOTHING * np.abs(values).max()] = 0.0
    crossing = np.flatnonzero(values[1:] * values[:-1] < 0.0)
    before, after = values[crossing], values[crossing + 1]
    roots = nodes[crossing] + np.diff(nodes)[crossing] * before / (before - after)
    order = np.argsort(np.concatenate((nodes, roots)), kind="stable")
    return (
        np.concatenate((nodes, roots))[order],
        np.concatenate((values, np.zeros_like(roots)))[order],
    )


def _values(mi: Any, rfilter: Any, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a filter's values."""
    if mi.Float is float:
        return np.array([rfilter.eval(place) for place in places.tolist()])
    return np.array(rfilter.eval(mi.Float(places.astype(np.float32))), np.float64)


def _area(nodes: NDArray[np.float64], lobe: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the area of a piecewise linear function left of each node."""
    area: NDArray[np.float64] = np.concatenate(
        ([0.0], np.cumsum(np.diff(nodes) * (lobe[1:] + lobe[:-1]) / 2.0))
    )
    return area


def _shares(
    nodes: NDArray[np.float64], lobe: NDArray[np.float64], length: int, cut: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the shares of a lobe that lie before the film and inside it, for each pixel."""
    area = _area(nodes, lobe)
    area /= area[-1]
    centre = np.arange(length) + 0.5
    if not cut:
        return np.zeros(length), np.ones(length)
    # Both ends are nodes, because pixels end half a pixel from their centres.
    begin = np.interp(-centre, nodes, area)
    return begin, np.interp(length - centre, nodes, area) - begin
