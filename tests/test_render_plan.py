"""What of a scene is left out: nothing that shows, and with what is kept the same bits."""

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from numpy.typing import NDArray

import sampling
from benchmarks.curves import difference
from sampling import Sampler, Samples, Settings, Watch
from sampling import plan as plans
from sampling.checkpoint import CheckpointError
from sampling.renderers import bounces
from sampling.renderers.bounces import BOTH, LIGHTS, MATERIALS
from sampling.renderers.mitsuba import MitsubaRenderer
from sampling.statistics import Statistics
from torch_vdm import VDM, Display

SIDE = 32

# Of a tolerance of 1 JND: the most that may be missing.
QUARTER = 0.25
Scene = dict[str, Any]
Picture = NDArray[np.float64]


@pytest.fixture(scope="module", autouse=True)
def small_pilots() -> Iterator[None]:
    # Of pictures that are too small for it to pay.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plans, "FEWEST_PIXELS", 1)
        yield


def grey(*colour: float) -> Scene:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def lamp(centre: list[float], radius: float, radiance: float) -> Scene:
    light = {"type": "area", "radiance": {"type": "rgb", "value": [radiance] * 3}}
    return {"type": "sphere", "center": centre, "radius": radius, "emitter": light}


def scene(mi: Any, integrator: Scene, eye: list[float], at: list[float], **things: Any) -> Scene:
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "pixel_format": "rgba"}
    view = mi.ScalarTransform4f().look_at(eye, at, [0, 1, 0])
    sensor = {"type": "perspective", "fov": 60, "to_world": view, "film": film}
    return {"type": "scene", "integrator": integrator, "sensor": sensor, **things}


def room(mi: Any, *colour: float, depth: int = 32, roulette: int = 64, **things: Any) -> Scene:
    """Return a closed room with a lamp, seen from its middle."""
    return scene(
        mi,
        {"type": "path", "max_depth": depth, "rr_depth": roulette},
        [0, 0, 0.9],
        [0, 0, -1],
        box={"type": "cube", "flip_normals": True, "bsdf": grey(*colour)},
        lamp=lamp([0.2, 0.7, -0.2], 0.1, 30.0),
        **things,
    )


def quad(to: Any, bsdf: Scene) -> Scene:
    return {"type": "rectangle", "to_world": to, "bsdf": {"type": "twosided", "bsdf": bsdf}}


def cast(mi: Any) -> Scene:
    """Return a dim room with one red wall, whose light reflects on the others."""
    place = mi.ScalarTransform4f().translate([-0.99, 0, 0]).rotate([0, 1, 0], 90)
    return room(mi, 0.15, 0.15, 0.15, depth=8, wall=quad(place, grey(0.7, 0.05, 0.05)))


def corner(mi: Any) -> Scene:
    """Return a room with a corner behind a screen, where no light of the lamp falls."""
    place = mi.ScalarTransform4f().translate([0.45, 0, -0.5]).rotate([0, 1, 0], 90)
    screen = quad(place.scale([0.5, 1, 1]), grey(0.02, 0.02, 0.02))
    dim = room(mi, 0.1, 0.1, 0.1, depth=8, screen=screen)
    dim["lamp"] = lamp([-0.6, 0.7, -0.2], 0.1, 30.0)
    return dim


def mirrors(mi: Any) -> Scene:
    """Return a dark room, with a lamp that is seen by way of two mirrors alone."""
    away = mi.ScalarTransform4f
    mirror = {"type": "conductor"}
    first = away().translate([0, 0, -0.8]).rotate([0, 1, 0], 45).scale(0.3)
    second = away().translate([0.8, 0, -0.8]).rotate([0, 1, 0], -135).scale(0.3)
    return room(mi, 0.0, 0.0, 0.0, one=quad(first, mirror), two=quad(second, mirror))


def fog_pixel(mi: Any) -> Scene:
    """Return an open scene with a ball of fog that is smaller than a pixel."""
    fog = {"type": "homogeneous", "albedo": 0.9, "sigma_t": 50.0}
    ball = {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.02}
    return plain(mi, fog=ball | {"bsdf": {"type": "null"}, "interior": fog})


def plain(mi: Any, depth: int = 4, **things: Any) -> Scene:
    """Return a ball on the ground under the sky, to be rendered as if there were media."""
    return scene(
        mi,
        {"type": "volpath", "max_depth": depth},
        [0, 1, 4],
        [0, 0.5, 0],
        ball={"type": "sphere", "center": [0, 0.5, 0], "radius": 0.5, "bsdf": grey(0.6, 0.4, 0.2)},
        ground=quad(mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(9), grey(0.5, 0.5, 0.4)),
        sky={"type": "constant"},
        **things,
    )


def rendered(of: Scene, effects: str, tolerance: float = 1.0, **options: Any) -> sampling.Result:
    return sampling.render(of, tolerance, effects=effects, seed=5, **options)


def drawn(of: Scene, count: int, depth: int | None = None, seed: int = 9) -> Picture:
    """Return samples of every pixel, (P, count, 3); of paths of no more than ``depth``."""
    renderer = MitsubaRenderer(of, seed=seed, variant="llvm_ad_rgb")
    if depth is not None:
        renderer.simulate(depth)
    pixels = np.arange(SIDE * SIDE)
    found = renderer.sample(pixels, 0 * pixels, np.full_like(pixels, count))
    return found.radiance.reshape(-1, count, 3).astype(np.float64)


@pytest.mark.parametrize(
    ("options", "aov"), [({}, False), ({"filter": "mitchell"}, True)], ids=["plain", "two rays"]
)
def test_bounces_are_those_of_path(mitsuba: Any, options: dict[str, Any], aov: bool) -> None:
    of = room(mitsuba, 0.4, 0.5, 0.6, depth=9, roulette=3)
    pixels = np.arange(SIDE * SIDE)
    which = pixels, 3 + 0 * pixels, 2 + 0 * pixels
    whole, told, short = (
        MitsubaRenderer(of, aov=aov, variant="llvm_ad_rgb", **options) for _ in range(3)
    )
    found = told.sample_bounces(*which, 3)
    np.testing.assert_array_equal(found.samples.radiance, whole.sample(*which).radiance)
    for name, plane in whole.aovs().items():
        np.testing.assert_array_equal(told.aovs()[name], plane)
    short.simulate(3)
    np.testing.assert_array_equal(found.within, short.sample(*which).radiance)
    assert (found.within != found.samples.radiance).any()


def plan_of(of: Scene, **options: Any) -> tuple[plans.Plan, bool]:
    renderer = MitsubaRenderer(of, variant="llvm_ad_rgb")
    settings = Settings(**options)
    return plans.read(renderer.needs, "auto", settings, renderer.size)


def test_no_media_no_volumetric_integrator(mitsuba: Any) -> None:
    plan, piloted = plan_of(plain(mitsuba))
    assert plan.integrator == "path"
    assert plan.max_depth == 4
    assert plan.bound == 0.0
    assert piloted
    renderer = MitsubaRenderer(plain(mitsuba), variant="llvm_ad_rgb")
    plan, piloted = plans.read(renderer.needs, "full", Settings(), renderer.size)
    assert plan.integrator is None
    assert not piloted


@pytest.mark.parametrize("what", ["medium", "null", "instance", "hidden"])
def test_a_volumetric_integrator_stays(mitsuba: Any, what: str) -> None:
    inside = {"type": "shapegroup", "ball": {"type": "sphere"}}
    of = {
        "medium": fog_pixel(mitsuba),
        "null": plain(mitsuba, veil={"type": "sphere", "bsdf": {"type": "null"}}),
        "instance": plain(
            mitsuba, group=inside, copy={"type": "instance", "ref": {"type": "ref", "id": "group"}}
        ),
        "hidden": plain(mitsuba),
    }[what]
    if what == "hidden":
        of["integrator"]["hide_emitters"] = True
    plan, piloted = plan_of(of)
    assert plan.integrator is None
    assert not piloted


def test_path_is_the_picture_of_volpath_without_media(mitsuba: Any) -> None:
    count, of = 512, plain(mitsuba, depth=3, lamp=lamp([2, 2, 1], 0.3, 20.0))
    one, other = drawn(of, count), drawn(of, count, depth=3, seed=10)
    deviation = np.sqrt((one.var(1, ddof=1) + other.var(1, ddof=1)) / count)
    apart = np.abs(one.mean(1) - other.mean(1))
    noisy = deviation > 0.0
    assert noisy.mean() > 0.5
    # Of as many scores as there are, at a significance of 1e-3.
    most = -NormalDist().inv_cdf(0.5 * (1.0 - (1.0 - 1e-3) ** (1.0 / noisy.sum())))
    assert (apart[noisy] / deviation[noisy]).max() < most
    assert apart[~noisy].max(initial=0.0) < 1e-6


def test_nothing_scatters(mitsuba: Any) -> None:
    plan, piloted = plan_of(room(mitsuba, 0.0, 0.0, 0.0))
    assert (plan.integrator, plan.max_depth) == ("path", 2)
    assert not piloted
    np.testing.assert_array_equal(
        drawn(room(mitsuba, 0.0, 0.0, 0.0), 4), drawn(room(mitsuba, 0.0, 0.0, 0.0), 4, depth=2)
    )


@pytest.mark.parametrize("what", ["mirror", "glass", "smooth", "veil", "rough", "few"])
def test_where_a_pilot_is_believed(mitsuba: Any, what: str) -> None:
    materials = {
        "mirror": {"type": "twosided", "bsdf": {"type": "conductor"}},
        "glass": {"type": "dielectric"},
        "smooth": {"type": "roughconductor", "alpha": 0.02},
        "veil": {"type": "mask", "opacity": 0.5, "bsdf": grey(0.5, 0.5, 0.5)},
        "rough": {"type": "twosided", "bsdf": {"type": "roughplastic", "alpha": 0.2}},
        "few": grey(0.1, 0.1, 0.1),
    }
    ball = {"type": "sphere", "radius": 0.1, "bsdf": materials[what]}
    of = room(mitsuba, 0.1, 0.1, 0.1, ball=ball)
    options = {"max_spp": 8} if what == "few" else {}
    assert plan_of(of, **options)[1] == (what == "rough")
    if what == "mirror":  # a light that has no area is never met by chance
        of["lamp"] = {"type": "point", "position": [0, 0.5, 0], "intensity": 1.0}
        assert plan_of(of)[1]


def test_a_cut_is_the_picture_of_a_scene_that_asks_for_less(mitsuba: Any, tmp_path: Path) -> None:
    of = room(mitsuba, 0.05, 0.05, 0.05)
    auto = rendered(of, "auto", aov=True)
    plan = auto.figures["plan"]
    assert plan["integrator"] == "path"
    depth, bound = plan["max_depth"], plan["left_out_jnd"]
    assert 2 <= depth < 32
    assert 0.0 < bound <= QUARTER
    # The only light of a dim room is that of the lamp, at which rays are aimed.
    assert plan["light_found_by"] == LIGHTS
    by_lights = alone(mitsuba, depth, 64, LIGHTS)
    short = rendered(of, "full", 1.0 - bound, aov=True, integrator=by_lights)
    np.testing.assert_array_equal(auto.image, short.image)
    np.testing.assert_array_equal(auto.samples, short.samples)
    np.testing.assert_allclose(auto.jnd, short.jnd + bound, rtol=1e-12)
    for name, plane in short.aovs.items():
        np.testing.assert_array_equal(auto.aovs[name], plane)
    assert auto.figures["predicted_max_jnd"] == pytest.approx(
        short.figures["predicted_max_jnd"] + bound
    )
    assert auto.figures["predicted_max_jnd"] <= 1.0
    assert auto.converged
    assert f"paths of more than {depth} segments" in plan["why"]
    assert "rays aimed at lights alone give the same picture" in plan["why"]
    json.dumps(auto.figures)
    auto.save(tmp_path / "out.exr")
    with OpenEXR.File(str(tmp_path / "out.exr")) as file:
        assert file.header()["plan"] == plan["why"]
    assert shown(of, depth) <= bound


def alone(mi: Any, depth: int, roulette: int, found_by: str) -> Any:
    """Return the integrator that finds light in one way alone."""
    # Not at the top, where Dr.Jit would choose its LLVM.
    return bounces.alone(mi, importlib.import_module("drjit"), depth, roulette, found_by)


def shown(of: Scene, depth: int) -> float:
    """Return how much leaving out longer paths shows, JND, from many samples of the same paths."""
    count = 256
    whole, short = (
        drawn(of, count, limit).mean(1).reshape(SIDE, SIDE, 3) for limit in (None, depth)
    )
    return float(difference(VDM(60.0, Display.linear(100.0)), whole, short).max())


@pytest.mark.parametrize("adversary", [cast, corner], ids=["faint cast", "dark corner"])
def test_a_bounce_that_shows_is_kept(mitsuba: Any, adversary: Any) -> None:
    of = adversary(mitsuba)
    auto = rendered(of, "auto")
    depth = auto.figures["plan"]["max_depth"]
    # Direct light alone would be the cheapest, and it shows.
    assert shown(of, 2) > QUARTER
    assert depth > 2
    assert shown(of, depth) <= QUARTER


@pytest.mark.parametrize("adversary", [mirrors, fog_pixel], ids=["two mirrors", "one pixel of fog"])
def test_what_is_seldom_seen_is_kept_bit_for_bit(mitsuba: Any, adversary: Any) -> None:
    of = adversary(mitsuba)
    auto, full = rendered(of, "auto", 2.0), rendered(of, "full", 2.0)
    np.testing.assert_array_equal(auto.image, full.image)
    assert auto.figures["plan"]["left_out"] == []
    assert auto.image.max() > 0.5


def test_a_pilot_that_keeps_everything_leaves_no_trace(mitsuba: Any) -> None:
    of = room(mitsuba, 0.5, 0.5, 0.5, roulette=3)
    auto, full = rendered(of, "auto", 2.0, aov=True), rendered(of, "full", 2.0, aov=True)
    assert "the mean of the picture alone" in auto.figures["plan"]["why"]
    assert auto.figures["samples_total"] == full.figures["samples_total"]
    np.testing.assert_array_equal(auto.image, full.image)
    np.testing.assert_array_equal(auto.jnd, full.jnd)
    for name, plane in full.aovs.items():
        np.testing.assert_array_equal(auto.aovs[name], plane)


def even(mi: Any, depth: int = 4, **lights: Any) -> Scene:
    """Return a ball on the ground, under an even sky unless there are other lights."""
    of = plain(mi, **lights)
    of["integrator"] = {"type": "path", "max_depth": depth}
    if lights:
        del of["sky"]
    return of


def test_under_an_even_sky_light_is_found_by_materials(mitsuba: Any) -> None:
    of = even(mitsuba)
    auto, full = rendered(of, "auto", aov=True), rendered(of, "full")
    plan = auto.figures["plan"]
    assert plan["light_found_by"] == MATERIALS
    assert "rays that materials scatter alone give the same picture" in plan["why"]
    assert auto.converged
    # Fewer samples, each of fewer rays.
    assert auto.figures["samples_total"] < 0.7 * full.figures["samples_total"]
    by_materials = alone(mitsuba, 4, 5, MATERIALS)
    same = rendered(of, "full", aov=True, integrator=by_materials)
    np.testing.assert_array_equal(auto.image, same.image)
    np.testing.assert_array_equal(auto.samples, same.samples)
    for name, plane in same.aovs.items():
        np.testing.assert_array_equal(auto.aovs[name], plane)
    # The promise.
    many = drawn(of, 4096).mean(1).reshape(SIDE, SIDE, 3)
    assert difference(VDM(60.0, Display.linear(100.0)), auto.image, many).max() <= 1.0


def sun(mi: Any) -> Scene:
    """Return an environment that is dim and even but for one pixel, which lights the scene."""
    sky = np.full((64, 128, 3), 0.1, np.float32)
    sky[12, 40] = 2e3
    return {"type": "envmap", "bitmap": mi.Bitmap(sky)}


@pytest.mark.parametrize("what", ["tiny lamp", "lamp in the sky", "point", "sun"])
def test_light_that_materials_seldom_meet_is_aimed_at(mitsuba: Any, what: str) -> None:
    lights: dict[str, Scene] = {
        "tiny lamp": {"lamp": lamp([1, 3, 1], 0.01, 3e4)},
        "lamp in the sky": {"dome": {"type": "constant"}, "lamp": lamp([1, 1, 1], 0.003, 2e4)},
        "point": {
            "dome": {"type": "constant"},
            "lamp": {"type": "point", "position": [1, 1, 1], "intensity": 0.3},
        },
        "sun": {"sun": sun(mitsuba)},
    }
    # No ray is the last one, whose light another has found.
    of = even(mitsuba, 32, **lights[what])
    auto, full = rendered(of, "auto", 0.7), rendered(of, "full", 0.7)
    plan = auto.figures["plan"]
    assert auto.figures["rounds"] > 1
    if what == "sun":  # rays aimed by the sky's brightness do alone, or nearly
        assert plan["light_found_by"] in (BOTH, LIGHTS)
        return
    assert plan["light_found_by"] == BOTH
    assert "neither alone would find light with less work" in plan["why"]
    np.testing.assert_array_equal(auto.image, full.image)


@pytest.mark.parametrize("what", ["lamp in the sky", "sun"])
def test_a_pilot_that_never_met_the_lamp_is_not_believed(
    mitsuba: Any, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    # Even if the first glance took materials alone for cheap.
    lights: dict[str, Scene] = {
        "lamp in the sky": {"dome": {"type": "constant"}, "lamp": lamp([1, 1, 1], 0.003, 2e4)},
        "sun": {"sun": sun(mitsuba)},
    }
    of = even(mitsuba, 4, **lights[what])
    monkeypatch.setattr(plans, "_glanced_noise", lambda _, way: 0.1 if way == MATERIALS else 1.0)
    plan = rendered(of, "auto", 0.7).figures["plan"]
    assert plan["evidence"]["light_considered"] == MATERIALS
    assert plan["evidence"]["times_the_samples"] > 2.0
    assert plan["light_found_by"] == BOTH
    assert "rays that materials scatter alone would need" in plan["why"]


class EndsAfter(Watch):
    """Ends a run at once, after so many parts."""

    def __init__(self, parts: int) -> None:
        self._left = parts

    def part(self, samples: int, speed: float) -> None:
        """Count."""
        del samples, speed
        self._left -= 1

    def presses(self) -> int:
        """Return 2 at the end."""
        return 0 if self._left > 0 else 2


OPTIONS: dict[str, Any] = {"tolerance": 1.0, "seed": 5}

DIM = """<scene version="3.0.0">
<integrator type="path"><integer name="max_depth" value="32"/>
  <integer name="rr_depth" value="64"/></integrator>
<sensor type="perspective"><float name="fov" value="60"/><transform name="to_world">
  <lookat origin="0,0,0.9" target="0,0,-1" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film>
</sensor>
<shape type="cube"><boolean name="flip_normals" value="true"/><bsdf type="diffuse">
  <rgb name="reflectance" value="0.05"/></bsdf></shape>
<shape type="sphere"><point name="center" value="0.2,0.7,-0.2"/><float name="radius" value="0.1"/>
  <emitter type="area"><rgb name="radiance" value="30"/></emitter></shape></scene>"""


@pytest.fixture(scope="module")
def dim(
    mitsuba: Any, small_pilots: None, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, sampling.Result]:
    """Return a scene that is cut, and its picture with `OPTIONS`."""
    del mitsuba, small_pilots
    path = tmp_path_factory.mktemp("dim") / "dim.xml"
    path.write_text(DIM)
    return path, sampling.render(path, **OPTIONS)


def test_interrupted_anywhere_the_same_bits(
    dim: tuple[Path, sampling.Result], tmp_path: Path
) -> None:
    (path, whole), kept = dim, tmp_path / "kept.npz"
    assert whole.figures["plan"]["left_out_jnd"] > 0.0
    reasons: list[str] = []
    # Within the pilot, after its first part; then after a part of the second round.
    ended = sampling.render(path, **OPTIONS, checkpoint=kept, watch=EndsAfter(1))
    reasons.append(ended.stop_reason)
    with pytest.warns(UserWarning, match="within the first round, of which nothing is kept"):
        ended = sampling.render(path, **OPTIONS, checkpoint=kept, resume=kept, watch=EndsAfter(3))
    reasons.append(ended.stop_reason)
    assert reasons == ["interrupted", "interrupted"]
    assert ended.figures["plan"]["left_out_jnd"] > 0.0
    with pytest.raises(CheckpointError, match="begun with --effects auto, and this is full"):
        sampling.render(path, **OPTIONS, effects="full", resume=kept)
    resumed = sampling.render(path, **OPTIONS, resume=kept)
    np.testing.assert_array_equal(resumed.image, whole.image)
    assert resumed.figures["plan"] == whole.figures["plan"]


class EndsTheJudging(Watch):
    """Ends a run at once, while its pilot is judged."""

    judging = False

    def presses(self) -> int:
        """Return 2 while it is."""
        return 2 if self.judging else 0


def test_interrupted_while_the_pilot_is_judged(
    dim: tuple[Path, sampling.Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (path, whole), kept, watch = dim, tmp_path / "kept.npz", EndsTheJudging()
    settle = plans.Pilot.settle

    def judged(self: plans.Pilot, *look: Any) -> None:
        watch.judging = True
        settle(self, *look)

    def waited(*_: Any) -> None:
        raise AssertionError

    with monkeypatch.context() as patch:
        patch.setattr(plans.Pilot, "settle", judged)
        # The longest piece of its work is not begun.
        patch.setattr(Sampler, "largest_without", waited)
        ended = sampling.render(path, **OPTIONS, checkpoint=kept, watch=watch)
    assert ended.stop_reason == "interrupted"
    assert ended.report is not None
    assert ended.figures["plan"]["left_out"] == []
    # What the plan would have been is not known: the same bits need the pilot again.
    with pytest.warns(UserWarning, match="within the first round, of which nothing is kept"):
        resumed = sampling.render(path, **OPTIONS, resume=kept)
    np.testing.assert_array_equal(resumed.image, whole.image)


class EndsItsRound(Watch):
    """Ends a run with the round that it is in."""

    def presses(self) -> int:
        """Return 1."""
        return 1


def test_a_first_round_that_is_completed_is_kept(
    dim: tuple[Path, sampling.Result], tmp_path: Path
) -> None:
    (path, whole), kept = dim, tmp_path / "kept.npz"
    first = sampling.render(path, **OPTIONS, checkpoint=kept, watch=EndsItsRound())
    assert first.stop_reason == "interrupted"
    assert first.figures["plan"] == whole.figures["plan"]
    # No warning, which is an error: nothing is begun anew.
    resumed = sampling.render(path, **OPTIONS, resume=kept)
    np.testing.assert_array_equal(resumed.image, whole.image)
    assert resumed.figures["samples_total"] == whole.figures["samples_total"]


def told(mean: float, deviation: float, count: int = 64) -> Statistics:
    """Return statistics of a plain picture."""
    statistics = Statistics(SIDE * SIDE, halves=False)
    pixels = np.repeat(np.arange(SIDE * SIDE), count)
    rng = np.random.default_rng(3)
    light = mean + deviation * rng.standard_normal((len(pixels), 1))
    statistics.add(Samples(pixels, np.repeat(light, 3, 1).astype(np.float32)))
    return statistics


def test_the_bound_of_what_is_left_out() -> None:
    metric = VDM(60.0, Display.linear(100.0))
    sampler = Sampler((SIDE, SIDE), metric, Settings(pilot=64))
    pixels = np.arange(SIDE * SIDE)
    for part in (sampler.ask(),):
        assert part is not None
        grey = np.full((part.samples, 3), 0.4, np.float32)
        sampler.tell(Samples(np.repeat(pixels, 64), grey))
    assert sampler.largest_without(told(0.0, 0.0)) == 0.0
    # What it is exactly, where nothing is noisy; 3 % on top are for what the model is wrong by.
    whole = torch.full((1, 3, SIDE, SIDE), 0.4)
    for share in (0.002, 0.02):
        exact = float(metric(whole, whole - share).max())
        bound = sampler.largest_without(told(share, 0.0))
        assert exact <= bound <= 1.1 * exact
    # Noise in what is known of it is no excuse.
    sure, unsure = (sampler.largest_without(told(0.002, noise)) for noise in (0.0, 0.05))
    assert unsure > 1.5 * sure


def test_together_they_stay_within(mitsuba: Any) -> None:
    # What the noise shows and what is left out shows add up to no less than both at once do.
    of = room(mitsuba, 0.1, 0.1, 0.1, depth=8)
    metric = VDM(60.0, Display.linear(100.0))
    whole, short = (drawn(of, 256, cut).mean(1).reshape(SIDE, SIDE, 3) for cut in (None, 3))
    for count in (4, 16, 64):
        noisy = drawn(of, count, 3, seed=10).mean(1).reshape(SIDE, SIDE, 3)
        parts = difference(metric, noisy, short).max() + difference(metric, short, whole).max()
        assert difference(metric, noisy, whole).max() <= parts
