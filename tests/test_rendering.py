"""``sampling.render``: the same run from Python, in a program that has other things to do."""

import importlib
import re
import shlex
import signal
import subprocess
import sys
import time
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import sampling
from benchmarks.places import ROOT
from sampling import Result, Samples, Watch, rendering
from sampling.checkpoint import CheckpointError
from sampling.cli import main
from sampling.prediction import Model
from sampling.renderers.mitsuba import MitsubaRenderer, SceneError
from tests.test_render_cli import channels
from torch_vdm import Observer

SMALL = {"width": "12", "height": "8"}
TOLERANCE = 0.7

TWO = """
<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective" id="front"><float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film>
</sensor>
<sensor type="perspective"><float name="fov" value="40"/>
  <transform name="to_world"><lookat origin="5,1,0" target="0,0,0" up="0,1,0"/></transform>
  <film type="hdrfilm"><integer name="width" value="7"/><integer name="height" value="9"/>
    <rfilter type="mitchell"/></film>
</sensor>
<emitter type="constant"/><shape type="sphere"/></scene>
"""
DARK: dict[str, Any] = {
    "type": "scene",
    "i": {"type": "volpath"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
    "ball": {"type": "sphere"},
}


@pytest.fixture(scope="module")
def path(mitsuba: Any) -> Path:  # noqa: ARG001  # skips
    """Return the scene that ships with the package."""
    with as_file(files("sampling") / "scenes" / "still_life.xml") as path:
        return path


@pytest.fixture(scope="module")
def whole(path: Path) -> Result:
    """Return a picture of it."""
    return sampling.render(path, TOLERANCE, seed=7, aov=True, parameters=SMALL)


@pytest.fixture
def two(mitsuba: Any, tmp_path: Path) -> Path:  # noqa: ARG001  # skips
    """Return a scene with two sensors, of which one has an id."""
    scene = tmp_path / "two.xml"
    scene.write_text(TWO)
    return scene


def same(one: Result, other: Result) -> None:
    """Assert that two pictures are the same, bit for bit."""
    for name in ("image", "samples", "jnd", "variance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert set(one.aovs) == set(other.aovs)
    for name, plane in one.aovs.items():
        np.testing.assert_array_equal(plane, other.aovs[name], err_msg=name)


def test_it_is_what_the_command_writes(whole: Result, path: Path, tmp_path: Path) -> None:
    assert whole.image.shape == whole.variance.shape == (8, 12, 3)
    assert whole.samples.shape == whole.jnd.shape == (8, 12)
    assert whole.converged
    assert whole.report is not None
    assert whole.report.predicted == whole.jnd.max() <= TOLERANCE
    assert whole.samples.sum() == whole.report.samples == whole.figures["samples_total"]
    whole.save(tmp_path / "ours.exr")
    words = [str(path), "--tolerance", str(TOLERANCE), "--seed", "7", "--aov"]
    words += [f"-D{name}={value}" for name, value in SMALL.items()]
    assert main([*words, "--output", str(tmp_path / "theirs.exr")]) == 0
    ours, theirs = channels(tmp_path / "ours.exr"), channels(tmp_path / "theirs.exr")
    assert set(ours) == set(theirs) >= {"R", "G", "B", "samples", "jnd", "albedo.R", "depth.Z"}
    for name, plane in ours.items():
        np.testing.assert_array_equal(plane, theirs[name], err_msg=name)
    image = np.stack([ours[name] for name in "RGB"], -1)
    np.testing.assert_array_equal(image, whole.image.astype(np.float32))
    with pytest.raises(ValueError, match=r"out.png: expected a name that ends in .exr"):
        whole.save(tmp_path / "out.png")


def test_a_scene_that_is_loaded_is_rendered_and_left_alone(
    mitsuba: Any, path: Path, whole: Result
) -> None:
    mitsuba.set_variant("llvm_ad_rgb")
    scene = mitsuba.load_file(str(path), **SMALL)
    before = np.array(mitsuba.render(scene, spp=4, seed=1))
    loaded = sampling.render(scene, TOLERANCE, seed=7, aov=True)
    same(loaded, whole)
    assert loaded.figures["plan"]["integrator"] == whole.figures["plan"]["integrator"] == "path"
    assert loaded.figures["plan"]["max_depth"] == whole.figures["plan"]["max_depth"] == 4
    np.testing.assert_array_equal(before, np.array(mitsuba.render(scene, spp=4, seed=1)))
    # Its own variant, whichever is set.
    mitsuba.set_variant("scalar_rgb")
    same(sampling.render(scene, TOLERANCE, seed=7, aov=True), whole)
    assert mitsuba.variant() == "scalar_rgb"


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
def test_a_dict_is_the_scene_that_it_describes(mitsuba: Any, variant: str) -> None:
    mitsuba.set_variant(variant)
    scene = mitsuba.cornell_box()
    scene["sensor"]["film"] |= {"width": 8, "height": 8}
    ours = sampling.render(scene, max_spp=16)
    assert ours.figures["variant"] == variant
    same(ours, sampling.render(mitsuba.load_dict(scene), max_spp=16))
    assert ours.figures["plan"]["pixel_filter"] == "gaussian"
    assert (ours.stop_reason, ours.converged) == ("max_spp", False)


def test_the_program_around_it_is_left_as_it_was(
    mitsuba: Any, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drjit = importlib.import_module("drjit")

    mitsuba.set_variant("scalar_rgb")
    before = mitsuba.log_level()
    threads = torch.get_num_threads()
    mitsuba.set_log_level(mitsuba.LogLevel.Warn)
    torch.set_num_threads(2)
    try:

        def state() -> tuple[Any, ...]:
            return (
                mitsuba.variant(),
                mitsuba.log_level(),
                drjit.thread_count(),
                torch.get_num_threads(),
            )

        found = state()
        sampling.render(path, max_spp=2, parameters=SMALL, variant="llvm_ad_rgb")
        assert state() == found
        with pytest.raises(SceneError, match="no such file"):
            sampling.render(path.with_name("none.xml"))
        assert state() == found

        def broken(*_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr(MitsubaRenderer, "sample", broken)
        with pytest.raises(KeyboardInterrupt):
            sampling.render(path, parameters=SMALL, variant="llvm_ad_rgb")
        assert state() == found
    finally:
        mitsuba.set_log_level(before)
        torch.set_num_threads(threads)


def test_importing_it_imports_no_mitsuba() -> None:
    code = (
        "import sys, sampling; sampling.render; import sampling.cli; "
        "sys.exit(any(name in sys.modules for name in ('mitsuba', 'drjit', 'OpenEXR', 'rich')))"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_a_sensor_is_chosen_by_number_or_id(two: Path) -> None:
    front, side = (sampling.render(two, max_spp=4, sensor=number) for number in (0, 1))
    assert (front.image.shape, side.image.shape) == ((6, 8, 3), (9, 7, 3))
    assert [r.figures["sensor"] for r in (front, side)] == ["front", 1]
    assert [r.figures["plan"]["pixel_filter"] for r in (front, side)] == ["gaussian", "mitchell"]
    same(sampling.render(two, max_spp=4, sensor="front"), front)
    for wanted in (2, -1, "back", ""):
        with pytest.raises(SceneError, match=r"expected a sensor from 0 to 1, or front, got"):
            sampling.render(two, sensor=wanted)


def test_alpha_is_written_where_the_film_has_it(mitsuba: Any, two: Path, tmp_path: Path) -> None:
    two.write_text(
        TWO.replace(
            '<rfilter type="mitchell"/>', '<string name="pixel_format" value="rgba"/>'
        ).replace('<emitter type="constant"/>', '<emitter type="point"/>')
    )
    result = sampling.render(two, max_spp=256, tolerance=1e-3, sensor=1, aov=True)
    result.save(tmp_path / "out.exr")
    planes = channels(tmp_path / "out.exr")
    assert {"A", "albedo.R", "depth.Z"} < set(planes)
    mitsuba.set_variant("llvm_ad_rgb")
    wanted = np.array(mitsuba.render(mitsuba.load_file(str(two)), sensor=1, spp=4096))[..., 3]
    # Of 256 coins a share is off by 5 standard deviations, 0.16 at most, once in two million times.
    assert np.abs(planes["A"] - wanted).max() < 5.0 * 0.5 / 16.0
    assert planes["A"].min() == 0.0 < planes["A"].max() == 1.0
    assert "A" not in sampling.render(two, max_spp=4, sensor=0).aovs


def test_all_sensors_are_rendered_to_files_of_their_own(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, told = tmp_path / "out.exr", tmp_path / "out.json"
    words = [str(two), "--max-spp", "4", "--output", str(output)]
    assert main([*words, "--sensor", "all", "--json", str(told)]) == 0
    said = capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.glob("out*")) == ["out.0.exr", "out.1.exr", "out.json"]
    for number in (0, 1):
        assert f"written: {tmp_path}/out.{number}.exr" in said
        assert main([*words, "--sensor", str(number)]) == 0
        alone, together = channels(output), channels(tmp_path / f"out.{number}.exr")
        for name, plane in alone.items():
            np.testing.assert_array_equal(plane, together[name])
    assert re.findall(r'"sensor": (.*),\n    "sensors": 2', told.read_text()) == ['"front"', "1"]


def test_all_sensors_go_on_where_they_were_interrupted(
    two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(two), "--sensor", "all", "--max-spp", "4", "--output"]
    assert main([*words, str(tmp_path / "whole.exr")]) == 0
    draw = MitsubaRenderer.sample

    def interrupted(renderer: MitsubaRenderer, *request: Any) -> Samples:
        if renderer.sensor[0] == 1:
            for _ in range(2):
                signal.raise_signal(signal.SIGINT)
        return draw(renderer, *request)

    with monkeypatch.context() as patch:
        patch.setattr(MitsubaRenderer, "sample", interrupted)
        assert main([*words, str(tmp_path / "out.exr")]) == 130
    command = re.search(r"go on with: vdm-render (.*)\n", capsys.readouterr().err)
    assert command is not None
    assert main(shlex.split(command.group(1))) == 0
    for number in (0, 1):
        ours, wanted = (channels(tmp_path / f"{n}.{number}.exr") for n in ("out", "whole"))
        for name, plane in wanted.items():
            np.testing.assert_array_equal(ours[name], plane)


def test_a_run_that_was_ended_goes_on_from_its_checkpoint(
    whole: Result, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Impatient(Watch):
        ended = False

        def part(self, samples: int, speed: float) -> None:
            del speed
            self.ended = samples > 2000

        def presses(self) -> int:
            return 2 * self.ended

    for name in ("FIRST_PART", "SMALLEST_PART", "LARGEST_PART"):
        monkeypatch.setattr(rendering, name, 300)
    kept = tmp_path / "run.npz"
    options: dict[str, Any] = {"seed": 7, "aov": True, "parameters": SMALL}
    ended = sampling.render(path, TOLERANCE, checkpoint=kept, watch=Impatient(), **options)
    assert (ended.stop_reason, ended.converged) == ("interrupted", False)
    assert 2000 < ended.samples.sum() < whole.samples.sum()
    same(sampling.render(path, TOLERANCE, resume=kept, **options), whole)
    ended.save_checkpoint(tmp_path / "again.npz")
    same(sampling.render(path, TOLERANCE, resume=tmp_path / "again.npz", **options), whole)
    with pytest.raises(CheckpointError, match="begun with --observer calibrated, and this is"):
        sampling.render(path, TOLERANCE, resume=kept, observer=Observer.paper(), **options)
    with pytest.warns(UserWarning, match="no checkpoint yet"):
        same(sampling.render(path, TOLERANCE, resume=tmp_path / "none", **options), whole)


def test_a_large_image_keeps_to_its_number_of_threads(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, kept = torch.get_num_threads(), tmp_path / "run.npz"
    assert sampling.render(path, max_spp=2, parameters=SMALL).figures["threads"] == 1
    monkeypatch.setattr(rendering, "FEW_PIXELS", 0)
    seen = []
    decide = Model.simulated

    def watched(model: Model, *options: Any, **named: Any) -> NDArray[np.float64]:
        seen.append(torch.get_num_threads())
        return decide(model, *options, **named)

    monkeypatch.setattr(Model, "simulated", watched)

    class Ended(Watch):
        def presses(self) -> int:
            return 1

    try:
        torch.set_num_threads(2)
        options: dict[str, Any] = {"max_spp": 20, "parameters": SMALL}
        begun = sampling.render(path, 0.1, checkpoint=kept, watch=Ended(), **options)
        torch.set_num_threads(1)
        went_on = sampling.render(path, 0.1, resume=kept, **options)
    finally:
        torch.set_num_threads(before)
    assert (begun.stop_reason, went_on.stop_reason) == ("interrupted", "max_spp")
    assert begun.figures["threads"] == went_on.figures["threads"] == 2
    assert set(seen) == {2}


def test_the_clock_ends_a_decision(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decide, clock, now = Model.simulated, time.monotonic, {"decisions": 0, "late": 0.0}

    def second_takes_an_hour(model: Model, *options: Any, **named: Any) -> NDArray[np.float64]:
        now["decisions"] += 1
        if now["decisions"] == 2:
            now["late"] = 3600.0
        return decide(model, *options, **named)

    monkeypatch.setattr(Model, "simulated", second_takes_an_hour)
    monkeypatch.setattr(time, "monotonic", lambda: clock() + now["late"])
    result = sampling.render(path, 0.5, parameters=SMALL, time_limit=1800.0)
    assert (result.stop_reason, result.converged) == ("time_limit", False)
    assert now["decisions"] == 2
    # The picture has the samples of the second round; the prediction is that of the first.
    assert result.report is not None
    assert result.report.round == 1
    assert result.samples.sum() > result.report.samples == 16 * 96


def test_depth_needs_no_light(mitsuba: Any) -> None:
    mitsuba.set_variant("llvm_ad_rgb")
    sensor = DARK["sensor"] | {"to_world": mitsuba.ScalarTransform4f().translate([0, 0, -5])}
    result = sampling.render({**DARK, "sensor": sensor, "i": {"type": "depth"}}, max_spp=2)
    assert 4.0 <= result.image.max() < 5.0
    assert not result.figures["black"]


def test_a_grey_picture_is_told(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(two), "--output", str(tmp_path / "out.exr"), "--max-spp", "4"]
    assert main(words) == 0
    assert "grey: all samples are" in capsys.readouterr().out
    two.write_text(
        TWO.replace('"constant"/>', '"constant"><rgb name="radiance" value="1,1,2"/></emitter>')
    )
    assert main(words) == 0
    assert "grey:" not in capsys.readouterr().out


def test_a_black_picture_is_told(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    two.write_text(
        TWO.replace('"constant"/>', '"constant"><rgb name="radiance" value="0,0,0"/></emitter>')
    )
    assert main([str(two), "--output", str(tmp_path / "out.exr"), "--max-spp", "4"]) == 0
    assert "black: no sample has met any light" in capsys.readouterr().out


def test_a_line_is_shown_on_a_terminal_alone(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(rendering, "LINE_SECONDS", 0.0)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    sampling.render(path, max_spp=20, parameters=SMALL)
    told = capsys.readouterr()
    assert (told.out, told.err) == ("", "")
    monkeypatch.setenv("FORCE_COLOR", "1")  # which is how rich is told of a terminal
    sampling.render(path, max_spp=20, parameters=SMALL)
    told = capsys.readouterr()
    assert told.out == ""
    assert "million samples/s" in told.err


def test_what_cannot_be_rendered_is_refused_in_one_line(mitsuba: Any, path: Path) -> None:
    mitsuba.set_variant("llvm_ad_spectral_polarized")
    polarized = mitsuba.load_dict({"type": "scene", "sensor": {"type": "perspective"}})
    with pytest.raises(
        SceneError, match=r"got llvm_ad_spectral_polarized; .* llvm_ad_spectral bef"
    ):
        sampling.render(mitsuba.cornell_box())
    mitsuba.set_variant("llvm_ad_spectral")
    bands = {"type": "specfilm", "band": {"type": "spectrum", "value": [(400, 0.0), (700, 1.0)]}}
    with pytest.raises(SceneError, match="expected a film of colours, such as hdrfilm, got SpecF"):
        sampling.render({"type": "scene", "sensor": {"type": "perspective", "film": bands}})
    mitsuba.set_variant("llvm_ad_rgb")
    loaded = mitsuba.load_dict(mitsuba.cornell_box())
    cases: list[tuple[Any, dict[str, Any], str]] = [
        (3, {}, "a path, a dict or an mi.Scene, got int"),
        (loaded.sensors()[0], {}, "a path, a dict or an mi.Scene, got Perspective"),
        ({"type": "sphere"}, {}, 'a dict with "type": "scene"'),
        ({"type": "scene", "a": {"type": "velvet"}}, {}, "velvet"),
        (dict(DARK), {}, "the scene: expected a light, got none"),
        (mitsuba.load_dict(DARK), {}, "the scene: expected a light, got none"),
        (
            {**DARK, "light": {"type": "constant"}, "i": {"type": "aov", "aovs": "d:depth"}},
            {},
            "the scene: expected an integrator inside that of the type aov, got none",
        ),
        (loaded, {"parameters": {"width": "3"}}, "parameters with a scene in a file alone"),
        (loaded, {"variant": "scalar_rgb"}, "the variant of the scene, llvm_ad_rgb, got scalar"),
        (polarized, {}, "a variant among .*, got llvm_ad_spectral_polarized; .*"),
        (loaded, {"checkpoint": "run.npz"}, "expected a scene in a file with a checkpoint"),
        (path, {"effects": "none"}, "expected effects among auto, full, got 'none'"),
        (path, {"time_limit": 0.0}, "expected a time limit over 0 s, got 0.0"),
        (path, {"filter": "sinc"}, "expected a filter among"),
        (path, {"tolerance": -1.0}, "expected a tolerance over 0 JND"),
    ]
    for scene, options, words in cases:
        with pytest.raises(ValueError, match=words) as refusal:
            sampling.render(scene, **options)
        assert "\n" not in str(refusal.value)
