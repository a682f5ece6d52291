"""The scenes of the paper's Fig. 14, and what the paper says of where samples go in them."""

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import stats

from benchmarks.paper import AIMED, ISOLUMINANT, SCENES
from benchmarks.scenes.carpet import FILE, carpet
from sampling import Sampler, Settings
from sampling.renderers.mitsuba import MitsubaRenderer
from torch_vdm import VDM, Display, Observer

pytestmark = pytest.mark.usefixtures("mitsuba")

Plane = NDArray[np.float64]

SIDE = 32
SMALL = {"width": str(SIDE), "height": str(SIDE)}

# Of z-tests, split over all that are made in one.
SIGNIFICANCE = 1e-3

# The light's radius as it is seen from the sphere; contrast.xml.
RADIUS = math.radians(23.0)


def draw(path: Path, parameters: dict[str, str], count: int, seed: int = 0) -> Plane:
    """Return samples of every pixel, (P, count, 3)."""
    renderer = MitsubaRenderer(path, SMALL | parameters, seed=seed)
    pixels = np.arange(SIDE * SIDE)
    samples = renderer.sample(pixels, 0 * pixels, 0 * pixels + count)
    return samples.radiance.reshape(len(pixels), count, 3).astype(np.float64)


def inside() -> NDArray[np.bool_]:
    """Return which pixels lie whole in the sphere, (H, W); its radius is 0.894 of half a frame."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] + 0.5
    distance = np.hypot(x - 0.5 * SIDE, y - 0.5 * SIDE) / (0.5 * SIDE)
    near: NDArray[np.bool_] = distance < 1.0 / math.sqrt(1.5**2 - 1.0) - 2.0 / SIDE
    return near


def test_the_light_is_found_with_one_chance_wherever_it_is_seen() -> None:
    count = 400
    samples = draw(SCENES / "contrast.xml", {"blind": "1"}, count)
    hits = (samples[..., 0] > 0.0).sum(1).reshape(SIDE, SIDE)[inside()]
    chance = 1.0 - math.cos(RADIUS)
    expected = count * chance
    # As binomial as they should be: their spread over pixels, and their mean. The light is 100
    # away, not infinitely far, which changes the chance by up to 3 % over the sphere.
    spread = ((hits - expected) ** 2).sum() / (expected * (1.0 - chance))
    assert spread < stats.chi2.isf(SIGNIFICANCE, len(hits)) * 1.05
    assert hits.mean() == pytest.approx(expected, rel=0.03)


def test_blind_samples_of_both_materials_have_the_mean_of_aimed_ones() -> None:
    path, count = SCENES / "contrast.xml", 256
    aimed = draw(path, AIMED | {"material": "diffuse"}, 1024, seed=1)[..., 0]
    for parameters in ({}, {"material": "diffuse"}, AIMED):
        blind = draw(path, parameters, count, seed=2)[..., 0]
        error = blind.mean(1) - aimed.mean(1)
        deviation = np.sqrt(blind.var(1) / count + aimed.var(1) / 1024)
        seen = inside().reshape(-1)
        z = error[seen].sum() / np.sqrt((deviation[seen] ** 2).sum())
        assert abs(z) < stats.norm.isf(0.5 * SIGNIFICANCE / 3)


def test_the_carpet_is_what_its_script_makes() -> None:
    with Image.open(FILE) as image:
        np.testing.assert_array_equal(np.asarray(image), carpet())


def test_the_chromatic_scenes_colours_have_one_luminance() -> None:
    weights = np.array([0.2126, 0.7152, 0.0722])
    luminances = [
        float(weights @ [float(part) for part in colour.split(",")])
        for colour in ISOLUMINANT.values()
    ]
    assert luminances == pytest.approx([luminances[0]] * 3, rel=0.02)
    assert luminances[1] == pytest.approx(luminances[0], rel=1e-3)


def counted(name: str, strategy: str, spp: float, seed: int = 3) -> Plane:
    """Return samples of every pixel once a small run has taken so many a pixel, (H, W)."""
    renderer = MitsubaRenderer(SCENES / f"{name}.xml", SMALL, seed=seed)
    metric = VDM(60.0, Display.linear(100.0), Observer.paper())
    # From a pilot that has seen the light from everywhere.
    settings = Settings(strategy=strategy, tolerance=3.0, pilot=64)  # type: ignore[arg-type]
    sampler = Sampler(renderer.size, metric, settings)
    while (request := sampler.ask()) is not None and sampler.count.mean() < spp:
        for part in request.parts(2**20):
            sampler.tell(renderer.sample(part.pixels, part.first, part.count))
    return sampler.count.astype(np.float64)


def test_objective_samples_the_sphere_where_it_is_bright_perceptual_evenly() -> None:
    light = draw(SCENES / "contrast.xml", AIMED, 64)[..., 0].mean(1).reshape(SIDE, SIDE)[inside()]
    bright, dark = light > np.quantile(light, 0.9), light < np.quantile(light, 0.1)

    def brighter(strategy: str, seed: int) -> float:
        count = counted("contrast", strategy, 300.0, seed)[inside()]
        return float(count[bright].mean() / count[dark].mean())

    # Its samples go by the variance, which goes by the square of the light.
    square = (light[bright].mean() / light[dark].mean()) ** 2
    assert brighter("objective", 3) > 0.7 * square
    # 0.95 to 1.6 from run to run.
    assert 0.75 < np.mean([brighter("perceptual", seed) for seed in range(1, 9)]) < 1.33


def test_perceptual_samples_the_plain_rectangle_more_than_the_carpet() -> None:
    plain, rug = np.s_[5:-5, 4:14], np.s_[5:-5, 19:28]
    count = counted("masking", "perceptual", 1000.0)
    assert count[plain].mean() > 1.2 * count[rug].mean()
