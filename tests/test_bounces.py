"""Light that is found by rays aimed at lights alone, and by what materials scatter alone."""

import math
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sampling.renderers.bounces import BOTH, LIGHTS, MATERIALS
from sampling.renderers.mitsuba import Bounced, MitsubaRenderer

SIDE = 12

Scene = dict[str, Any]


def diffuse(*colour: float) -> Scene:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def scene(mi: Any, depth: int, eye: list[float], at: list[float], **things: Any) -> Scene:
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at(eye, at, [0, 1, 0])
    sensor = {"type": "perspective", "fov": 50, "to_world": view, "film": film}
    path = {"type": "path", "max_depth": depth, "rr_depth": 3}
    return {"type": "scene", "integrator": path, "sensor": sensor, **things}


def ground(mi: Any, bsdf: Scene) -> Scene:
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(50)
    return {"type": "rectangle", "to_world": flat, "bsdf": bsdf}


def under_the_sky(mi: Any) -> Scene:
    """Return balls of several materials under a sky with a gradient."""
    sky = np.linspace(0.2, 1.0, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3)
    return scene(
        mi,
        6,
        [0, 1.5, 4],
        [0, 0.4, 0],
        ground=ground(mi, diffuse(0.5, 0.4, 0.3)),
        one={"type": "sphere", "center": [-1.1, 0.5, 0], "radius": 0.5, "bsdf": diffuse(0.6, 0, 0)},
        two={
            "type": "sphere",
            "center": [0, 0.5, 0],
            "radius": 0.5,
            "bsdf": {"type": "roughconductor", "alpha": 0.2},
        },
        three={
            "type": "sphere",
            "center": [1.1, 0.5, 0],
            "radius": 0.5,
            "bsdf": {"type": "plastic"},
        },
        sky={"type": "envmap", "bitmap": mi.Bitmap(sky)},
    )


def in_a_room(mi: Any) -> Scene:
    """Return a closed room with a broad lamp and a narrow one, and a mirror."""
    place = mi.ScalarTransform4f().translate([0, 0.95, 0]).rotate([1, 0, 0], 90).scale(0.5)
    return scene(
        mi,
        5,
        [0, 0, 0.9],
        [0, 0, -1],
        box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5, 0.4, 0.3)},
        broad={"type": "rectangle", "to_world": place, "emitter": {"type": "area"}},
        narrow={
            "type": "sphere",
            "center": [0.3, -0.3, -0.3],
            "radius": 0.2,
            "emitter": {"type": "area", "radiance": 2.0},
        },
        mirror={
            "type": "sphere",
            "center": [-0.4, -0.5, -0.4],
            "radius": 0.3,
            "bsdf": {"type": "conductor"},
        },
    )


def told(of: Scene, count: int, cut: int | None, found_by: str, **options: Any) -> Bounced:
    renderer = MitsubaRenderer(of, variant="llvm_ad_rgb", seed=3, **options)
    pixels = np.arange(SIDE * SIDE)
    return renderer.sample_bounces(pixels, 0 * pixels, np.full_like(pixels, count), cut, found_by)


def simulated(of: Scene, count: int, depth: int | None, found_by: str, **options: Any) -> Any:
    renderer = MitsubaRenderer(of, variant="llvm_ad_rgb", **{"seed": 3, **options})
    renderer.simulate(depth, found_by)
    pixels = np.arange(SIDE * SIDE)
    return renderer.sample(pixels, 0 * pixels, np.full_like(pixels, count)).radiance


@pytest.mark.parametrize("found_by", [BOTH, LIGHTS, MATERIALS])
@pytest.mark.parametrize("of", [under_the_sky, in_a_room], ids=["sky", "room"])
@pytest.mark.parametrize("options", [{}, {"filter": "mitchell"}], ids=["box", "two rays"])
def test_what_is_told_of_is_what_is_drawn(
    mitsuba: Any, of: Any, found_by: str, options: dict[str, Any]
) -> None:
    for cut in (2, None):
        found = told(of(mitsuba), 4, cut, found_by, **options)
        depth = of(mitsuba)["integrator"]["max_depth"] if cut is None else cut
        np.testing.assert_array_equal(
            found.alone, simulated(of(mitsuba), 4, depth, found_by, **options)
        )
        assert (found.alone != found.within).any() == (found_by != BOTH)


@pytest.mark.parametrize("found_by", [LIGHTS, MATERIALS])
@pytest.mark.parametrize("of", [under_the_sky, in_a_room], ids=["sky", "room"])
def test_the_mean_is_that_of_mitsubas_own_image(mitsuba: Any, of: Any, found_by: str) -> None:
    count, spp = 4096, 4096
    depth = of(mitsuba)["integrator"]["max_depth"]
    alone, path = (
        simulated(of(mitsuba), count, depth, way, seed=seed)
        .reshape(-1, count, 3)
        .astype(np.float64)
        for way, seed in ((found_by, 3), (BOTH, 4))
    )
    image = np.array(mitsuba.render(mitsuba.load_dict(of(mitsuba)), spp=spp, seed=1))
    image = image[..., :3].reshape(-1, 3)
    deviation = np.sqrt(alone.var(1, ddof=1) / count + path.var(1, ddof=1) / spp)
    known = deviation > 0.0
    assert known.mean() > 0.6
    z = (alone.mean(1) - image)[known] / deviation[known]
    # Significance 1e-3 for the largest of all, and 1e-3 for their mean, whose channels go together.
    assert np.abs(z).max() < NormalDist().inv_cdf(1.0 - 1e-3 / (2.0 * z.size))
    assert abs(z.mean()) < NormalDist().inv_cdf(1.0 - 1e-3 / 2.0) / math.sqrt(z.size / 3.0)
    np.testing.assert_allclose(alone.mean(1)[~known], image[~known], rtol=1e-5)


def white_plane(mitsuba: Any, **lights: Any) -> Any:
    """Return the scene of a plane that scatters all light, seen from above."""
    white = ground(mitsuba, diffuse(1, 1, 1))
    return scene(mitsuba, 2, [0, 3, 0.1], [0, 0, 0], ground=white, **lights)


def squares(light: NDArray[np.float32]) -> NDArray[np.float64]:
    of: NDArray[np.float64] = (light.astype(np.float64) ** 2).sum(1)
    return of


def test_moments_on_a_plane_under_an_even_sky(mitsuba: Any) -> None:
    # By what a white material scatters every sample is 1; by rays aimed over the whole sphere it
    # is 4 cos in the upper half: second moments of 1 and 8 / 3, in each of three channels.
    of = white_plane(mitsuba, sky={"type": "constant"})
    count = 512
    for found_by, moment in ((MATERIALS, 3.0), (LIGHTS, 8.0)):
        found = told(of, count, None, found_by)
        for guess in (
            squares(found.within) + found.excess[found_by],
            squares(found.alone),
        ):
            error = guess.std(ddof=1) / math.sqrt(guess.size)
            limit = NormalDist().inv_cdf(1.0 - 1e-3 / 2.0)
            assert abs(guess.mean() - moment) <= limit * error + 1e-5


def test_moments_know_of_a_light_that_was_not_met(mitsuba: Any) -> None:
    # A lamp that one of a million rays of a material would meet: in a few of them the light is
    # missing, and so is its noise; not in what the aimed rays tell.
    lamp = {
        "type": "sphere",
        "center": [0, 30, 0],
        "radius": 0.02,
        "emitter": {"type": "area", "radiance": 1e6},
    }
    of = white_plane(mitsuba, lamp=lamp)
    found = told(of, 16, None, MATERIALS)
    assert squares(found.alone).max() == 0.0
    assert found.excess[MATERIALS].mean() > 1e4 * squares(found.within).mean()


def test_rays_are_counted(mitsuba: Any) -> None:
    # Of a plane under the sky: one from the eye, one aimed at the sky, one scattered, which is of
    # no use where light is found by aim.
    of = white_plane(mitsuba, sky={"type": "constant"})
    found = told(of, 4, None, BOTH)
    np.testing.assert_array_equal(found.rays, found.rays_within[BOTH])
    for found_by, rays in ((BOTH, 3), (LIGHTS, 2), (MATERIALS, 2)):
        np.testing.assert_array_equal(found.rays_within[found_by], rays)
    found = told(of, 4, 1, BOTH)
    np.testing.assert_array_equal(found.rays, 3)
    for rays_within in found.rays_within.values():
        np.testing.assert_array_equal(rays_within, 1)
