"""``vdm-render``, run as a user runs it: a scene in, an image and figures out."""

import json
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
import OpenEXR
import pytest
import torch
from numpy.typing import NDArray

from benchmarks.places import ROOT
from sampling import Samples, cli, rendering
from sampling.cli import main
from sampling.renderers.llvm import find_llvm
from sampling.renderers.mitsuba import MitsubaRenderer
from tests.conftest import one_line_error
from torch_vdm.io import load, write_channels

# FACE.md: what acceptance reads.
KEYS = {
    *("strategy", "seed", "tolerance", "rounds", "samples_total", "spp_mean"),
    *("predicted_max_jnd", "converged", "stop_reason", "seconds_render", "seconds_metric"),
    *("seconds_total", "variant", "plan"),
}
CHANNELS = {"R", "G", "B", "samples", "jnd", "variance.R", "variance.G", "variance.B"}

SMALL = ("-D", "width=12", "-D", "height=8")
PILOT = 16 * 12 * 8

# A run that looks at the clock, and writes a checkpoint, every 300 samples.
SLOW = """
import sys
from sampling import cli, rendering
rendering.CHECKPOINT_SECONDS = 0.0
rendering.FIRST_PART = rendering.SMALLEST_PART = rendering.LARGEST_PART = 300
sys.exit(cli.main())
"""


@pytest.fixture(scope="module")
def scene(mitsuba: Any) -> str:
    """Return the scene that ships."""
    del mitsuba
    with as_file(files("sampling") / "scenes" / "still_life.xml") as path:
        return str(path)


def channels(path: Path) -> dict[str, NDArray[np.float32]]:
    """Return the channels of an EXR file."""
    found = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: channel.pixels for name, channel in found.items()}


def same_image(one: Path, other: Path) -> None:
    """Assert that two files have the same channels, bit for bit."""
    ours, wanted = channels(one), channels(other)
    assert set(ours) == set(wanted)
    for name, plane in wanted.items():
        np.testing.assert_array_equal(ours[name], plane, err_msg=name)


def figures(path: Path) -> dict[str, Any]:
    """Return the JSON of a run."""
    told: dict[str, Any] = json.loads(path.read_text())
    return told


@pytest.fixture(scope="module")
def whole(scene: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path]:
    """Return the arguments of a run, without its output, and the image of it."""
    output = tmp_path_factory.mktemp("whole") / "out.exr"
    arguments = [scene, *SMALL, "--tolerance", "0.7", "--seed", "7", "--aov"]
    assert main([*arguments, "--output", str(output), "--json", f"{output}.json"]) == 0
    return arguments, output


def test_the_image_and_the_figures(whole: tuple[list[str], Path]) -> None:
    _, output = whole
    told, planes = figures(Path(f"{output}.json")), channels(output)
    assert set(told) >= KEYS
    assert (told["strategy"], told["seed"], told["tolerance"]) == ("perceptual", 7, 0.7)
    assert (told["stop_reason"], told["converged"]) == ("tolerance", True)
    assert 0.0 < told["predicted_max_jnd"] <= 0.7
    assert told["rounds"] >= 2
    assert told["variant"] in ("llvm_ad_rgb", "cuda_ad_rgb")
    assert (told["plan"]["integrator"], told["plan"]["max_depth"]) == ("path", 4)
    assert told["seconds_render"] + told["seconds_metric"] <= told["seconds_total"]
    aovs = {*(f"albedo.{name}" for name in "RGB"), *(f"normal.{name}" for name in "XYZ")}
    assert set(planes) == CHANNELS | aovs | {"depth.Z"}
    assert {plane.shape for plane in planes.values()} == {(8, 12)}
    assert planes["samples"].sum() == told["samples_total"]
    assert told["spp_mean"] == pytest.approx(told["samples_total"] / (12 * 8))
    assert planes["samples"].min() < planes["samples"].max()
    assert planes["jnd"].max() == pytest.approx(told["predicted_max_jnd"])
    assert told["visible_fraction"] == (planes["jnd"] > 1.0).mean()
    assert told["over_tolerance_fraction"] == (planes["jnd"] > told["tolerance"]).mean()
    assert all((planes[f"variance.{name}"] > 0.0).any() for name in "RGB")
    np.testing.assert_array_equal(
        load(output).pixels.numpy(), np.stack([planes[name] for name in "RGB"])
    )
    assert (told["filter"], told["plan"]["pixel_filter"]) == ("scene", "box")
    assert OpenEXR.File(str(output)).header()["pixelFilter"].startswith("BoxFilter")


def test_a_filter_is_chosen_and_told(scene: str, tmp_path: Path) -> None:
    output = tmp_path / "out.exr"
    words = [scene, *SMALL, "--max-spp", "16", "--aov", "--filter", "lanczos"]
    assert main([*words, "--output", str(output), "--json", f"{output}.json"]) == 0
    told = figures(Path(f"{output}.json"))
    assert (told["filter"], told["plan"]["pixel_filter"]) == ("lanczos", "lanczos")
    assert OpenEXR.File(str(output)).header()["pixelFilter"] == "LanczosSincFilter[lobes=3.000000]"
    # The picture is the mean of samples of that filter.
    renderer = MitsubaRenderer(scene, {"width": "12", "height": "8"}, filter="lanczos")
    pixels = np.arange(96)
    drawn = renderer.sample(pixels, 0 * pixels, 0 * pixels + 16)
    mean = drawn.radiance.reshape(8, 12, 16, 3).mean(2, np.float64)
    planes = channels(output)
    np.testing.assert_allclose(
        np.stack([planes[name] for name in "RGB"], -1), mean, rtol=1e-5, atol=1e-6
    )


def test_the_image_is_the_mean_of_the_pixels_samples(whole: tuple[list[str], Path]) -> None:
    arguments, output = whole
    planes = channels(output)
    renderer = MitsubaRenderer(arguments[0], {"width": "12", "height": "8"}, seed=7)
    pixel = int(planes["samples"].argmax())
    count = int(planes["samples"].max())
    samples = renderer.sample(np.array([pixel]), np.array([0]), np.array([count]))
    image = np.stack([planes[name].reshape(-1)[pixel] for name in "RGB"])
    np.testing.assert_allclose(image, samples.radiance.mean(0, np.float64), rtol=1e-6)


@pytest.mark.parametrize("part", [500, 2**21])
def test_the_same_command_gives_the_same_image_in_parts_of_any_size(
    whole: tuple[list[str], Path], tmp_path: Path, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_PART", "SMALLEST_PART", "LARGEST_PART"):
        monkeypatch.setattr(rendering, name, part)
    arguments, output = whole
    assert main([*arguments, "--output", str(tmp_path / "again.exr")]) == 0
    same_image(tmp_path / "again.exr", output)


def test_reproduce_reproduces(whole: tuple[list[str], Path], tmp_path: Path) -> None:
    _, output = whole
    program, *words = shlex.split(figures(Path(f"{output}.json"))["reproduce"])
    words[words.index("--output") + 1] = str(tmp_path / "again.exr")
    assert (program, main(words)) == ("vdm-render", 0)
    same_image(tmp_path / "again.exr", output)


def test_reproduce_names_the_threads_where_bits_depend_on_them(
    whole: tuple[list[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments, _ = whole
    monkeypatch.setattr(rendering, "FEW_PIXELS", 1)
    monkeypatch.setattr(cli, "FEW_PIXELS", 1)
    words = ["--output", str(tmp_path / "a.exr"), "--json", str(tmp_path / "a.json")]
    assert main([*arguments, *words]) == 0
    told = figures(tmp_path / "a.json")
    assert told["reproduce"].startswith(f"OMP_NUM_THREADS={torch.get_num_threads()} vdm-render ")
    assert told["threads"] == torch.get_num_threads()


@pytest.mark.parametrize("presses", [1, 2])
def test_ctrl_c_ends_the_round_and_says_how_to_go_on(
    whole: tuple[list[str], Path],
    tmp_path: Path,
    presses: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments, wanted = whole
    total = figures(Path(f"{wanted}.json"))["samples_total"]
    output = tmp_path / "out.exr"
    draw = MitsubaRenderer.sample
    # Once within the first round, or twice within the second.
    when = 0 if presses == 1 else PILOT
    drawn = 0

    def interrupted(renderer: MitsubaRenderer, *request: Any) -> Samples:
        nonlocal drawn
        samples = draw(renderer, *request)
        before, drawn = drawn, drawn + len(samples.pixels)
        if before <= when < drawn:
            for _ in range(presses):
                signal.raise_signal(signal.SIGINT)
        return samples

    with monkeypatch.context() as patch:
        patch.setattr(MitsubaRenderer, "sample", interrupted)
        for name in ("FIRST_PART", "SMALLEST_PART", "LARGEST_PART"):
            patch.setattr(rendering, name, 200)
        json_path = tmp_path / "out.json"
        assert main([*arguments, "--output", str(output), "--json", str(json_path)]) == 130
    told = figures(json_path)
    assert (told["stop_reason"], told["converged"]) == ("interrupted", False)
    planes = channels(output)
    assert planes["samples"].sum() == told["samples_total"]
    # Once: the round is complete. Twice: the next one is not.
    assert told["rounds"] == 1
    assert told["samples_total"] == PILOT if presses == 1 else PILOT < told["samples_total"] < total
    said = capsys.readouterr().err
    command = re.search(r"interrupted; go on with: (vdm-render .*)\n", said)
    assert command is not None
    _, *words = shlex.split(command.group(1))
    words[words.index("--json") + 1] = str(tmp_path / "resumed.json")
    assert main(words) == 0
    same_image(output, wanted)
    resumed = figures(tmp_path / "resumed.json")
    assert resumed["samples_total"] == total
    assert resumed["seconds_total"] > told["seconds_total"]


def test_ctrl_c_while_the_picture_is_written_loses_nothing(
    whole: tuple[list[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments, wanted = whole
    output, kept = tmp_path / "out.exr", tmp_path / "run.checkpoint"

    def interrupted(*picture: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        write_channels(*picture)

    monkeypatch.setattr(rendering, "write_channels", interrupted)
    assert main([*arguments, "--output", str(output), "--checkpoint", str(kept)]) == 0
    same_image(output, wanted)
    assert kept.is_file()


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_process_that_is_ended_is_resumed_to_the_same_image(
    whole: tuple[list[str], Path], tmp_path: Path, blow: signal.Signals
) -> None:
    arguments, wanted = whole
    output, kept = tmp_path / "out.exr", tmp_path / "run.checkpoint"
    words = [*arguments, "--output", str(output), "--checkpoint", str(kept)]
    with subprocess.Popen(
        [sys.executable, "-c", SLOW, *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        cwd=ROOT,
    ) as child:
        seen: set[int] = set()
        while len(seen) < 4:  # inodes: each checkpoint is a new file
            assert child.poll() is None, "ended by itself"
            if kept.exists():
                seen.add(kept.stat().st_mtime_ns)
            time.sleep(0.002)
        child.send_signal(blow)
        _, said = child.communicate(timeout=120)
    if blow != signal.SIGKILL:
        assert child.returncode == 130
        assert "go on with: vdm-render" in said
        assert output.exists()
    else:
        assert child.returncode == -blow
        assert not output.exists()
    assert main([*words, "--resume"]) == 0
    same_image(output, wanted)


def test_a_checkpoint_of_another_run_is_refused(
    whole: tuple[list[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, _ = whole
    kept = ["--checkpoint", str(tmp_path / "run"), "--output", str(tmp_path / "out.exr")]
    assert main([*arguments, *kept, "--max-spp", "16"]) == 0
    (tmp_path / "out.exr").unlink()
    capsys.readouterr()
    for change, words in (
        ((), "begun with --max-spp 16, and this is None"),
        (
            ("--max-spp", "16", "--seed", "8", "--effects", "full"),
            "begun with --seed 7, and this is 8",
        ),
        (("--max-spp", "16", "--filter", "tent"), "begun with --filter scene, and this is tent"),
        (("--max-spp", "16", "-D", "depth=3"), "another scene"),
        (("--max-spp", "16", "-D", "width=13"), "begun with image size 12 x 8"),
    ):
        assert main([*arguments, *kept, *change, "--resume"]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    (tmp_path / "run").write_bytes(b"nothing")
    assert main([*arguments, *kept, "--resume"]) == 2
    assert "damaged or another file" in capsys.readouterr().err


def test_without_a_checkpoint_yet_it_begins(
    scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [scene, *SMALL, "--output", str(tmp_path / "out.exr"), "--max-spp", "4", "--resume"]
    assert main(words) == 0
    assert "no checkpoint yet; starting from the beginning" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("limit", "reason"),
    [(("--time-limit", "1e-3"), "time_limit"), (("--max-spp", "20"), "max_spp")],
)
def test_limits_stop_without_a_promise(
    scene: str,
    tmp_path: Path,
    limit: tuple[str, str],
    reason: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "out.exr"
    assert main([scene, *SMALL, "--output", str(output), *limit, "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["stop_reason"], told["converged"]) == (reason, False)
    assert told["predicted_max_jnd"] > 1.0
    assert told["samples_max"] <= 20 or reason == "time_limit"
    assert channels(output)["samples"].sum() == told["samples_total"]


@pytest.mark.parametrize(
    "options",
    [("uniform",), ("objective",), ("halfbuffer",), ("halfbuffer", "--noise-threshold", "0.5")],
    ids=" ".join,
)
def test_every_strategy_renders(scene: str, tmp_path: Path, options: tuple[str, ...]) -> None:
    words = ["--strategy", *options, "--tolerance", "4", "--json", str(tmp_path / "out.json")]
    assert main([scene, *SMALL, "--output", str(tmp_path / "out.exr"), *words]) == 0
    told = figures(tmp_path / "out.json")
    assert told["strategy"] == options[0]
    assert told["converged"]
    assert told["predicted_max_jnd"] is not None


def test_what_is_not_finite_is_told(
    scene: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    del scene
    path = tmp_path / "nan.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="path"/><sensor type="perspective">'
        '<film type="hdrfilm"><integer name="width" value="8"/>'
        '<integer name="height" value="8"/></film></sensor><emitter type="constant"/>'
        '<shape type="sphere"><point name="center" x="1" y="0" z="4"/><bsdf type="diffuse">'
        '<rgb name="reflectance" value="nan,1,1"/></bsdf></shape></scene>'
    )
    words = [str(path), "--output", str(tmp_path / "out.exr")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert re.search(r"left out: \d+ samples that were NaN or infinite", said)
    assert re.search(r"black: \d+ pixels that have no finite sample", said)
    assert np.isfinite(channels(tmp_path / "out.exr")["R"]).all()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("none.xml",), "none.xml: expected a scene"),
        (("SCENE", "-D", "depth"), "expected name=value, got 'depth'"),
        (("SCENE", "-D", "hue=3"), "unused parameters"),
        (("SCENE", "--tolerance", "0"), "expected a number over 0, got '0'"),
        (("SCENE", "--max-spp", "1.5"), "expected a whole number over 0"),
        (("SCENE", "--seed", "-1"), "--seed"),
        (("SCENE", "--seed", "4294967296"), "expected a whole number from 0 to 4294967295"),
        (("SCENE", "--filter", "sinc"), "--filter"),
        (("SCENE", "--noise-threshold", "0.1"), "expected the halfbuffer strategy"),
        (("SCENE", "--output", "out.png"), "out.png: expected a name that ends in .exr"),
        (("SCENE", "--output", "nowhere/out.exr"), "expected the folder to exist"),
        (("SCENE", "--json", "out.exr"), "out.exr: expected a file of its own"),
        (("SCENE", "--checkpoint", "nowhere/run"), "expected the folder to exist"),
        ((), "SCENE.xml"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    scene: str,
    tmp_path: Path,
    words: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    given = [scene if word == "SCENE" else word for word in words]
    assert said in one_line_error(main, capsys, "--output", "out.exr", *given)
    assert list(tmp_path.iterdir()) == []


def test_an_unusable_llvm_ends_with_one_line(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find_llvm.cache_clear()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so"))
    try:
        assert main([scene, "--output", str(tmp_path / "out.exr")]) == 2
    finally:
        find_llvm.cache_clear()
    told = capsys.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert "expected an LLVM library" in told.err
