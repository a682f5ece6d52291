"""Files on which the metric was once wrong, each against a file that says the same otherwise."""

import json
from pathlib import Path

import pytest
import torch

from torch_vdm.cli import main
from torch_vdm.io import load


@pytest.fixture
def field(shared_data: Path) -> Path:
    """Return the folder of these files; without it the test is skipped."""
    folder = shared_data / "field"
    if not folder.is_dir():
        pytest.skip(f"no files at {folder}")
    return folder


def compared(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> dict[str, object]:
    """Return the figures of two files; of words, those with a dot before their end are files."""
    arguments = [str(folder / word) if Path(word).suffix else word for word in words]
    assert main(["compare", *arguments, "--json", "-"]) == 0
    figures: dict[str, object] = json.loads(capsys.readouterr().out)
    return figures


def jnd(capsys: pytest.CaptureFixture[str], folder: Path, *words: str) -> float:
    return float(str(compared(capsys, folder, *words)["max_jnd"]))


def test_the_picture_of_a_multilayer_file(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = "01-blender-multilayer/reference.exr", "01-blender-multilayer/test.exr"
    assert jnd(capsys, field, *pair) == jnd(capsys, field, *pair, "--part", "Combined") > 3.0
    assert jnd(capsys, field, *pair, "--part", "AO") == 0.0


def test_transparency(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert jnd(capsys, field, "02-alpha/opaque.png", "02-alpha/seethrough.png") > 10.0


def test_pq_is_the_light_of_its_twin(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = field / "03-cicp-pq"
    for name in ("reference", "test"):
        picture = load(folder / f"{name}.png").pixels / 100.0
        twin = load(folder / f"{name}.exr", negative="keep").pixels
        torch.testing.assert_close(picture, twin, rtol=1e-3, atol=1e-3)
    light = jnd(capsys, folder, "reference.exr", "test.exr", "--negative", "keep")
    assert jnd(capsys, folder, "reference.png", "test.png") == pytest.approx(light, abs=0.01)


def test_a_linear_profile_is_linear(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = field / "04-linear-icc"
    light = jnd(capsys, folder, "reference.exr", "test.exr")
    coded = jnd(capsys, folder, "linear-reference.png", "linear-test.png")
    assert coded == pytest.approx(light, abs=0.01)
    assert jnd(capsys, folder, "reference.exr", "linear-reference.png") < 0.05


@pytest.mark.parametrize("name", ["view", "vray", "words"])
def test_names_of_channels(field: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    pair = f"05-exr-names/{name}-reference.exr", f"05-exr-names/{name}-test.exr"
    assert jnd(capsys, field, *pair) > 1.0
    if name == "view":
        assert "the views left and right are compared" in str(compared(capsys, field, *pair))


def test_infinity_is_the_largest_half(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = "06-extremes/half-inf.exr", "06-extremes/half-max.exr"
    assert jnd(capsys, field, *pair, "--nonfinite", "clamp") == 0.0


def test_orientation(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for one, other in (("upright.png", "copy.png"), ("phone.jpg", "copy.png")):
        assert jnd(capsys, field / "07-orientation", one, other) < 0.5


def test_formats(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = field / "08-formats"
    assert main(["compare", str(folder / "anim1.png"), str(folder / "anim2.png")]) == 2
    assert "got an animation of 2" in capsys.readouterr().err
    assert jnd(capsys, folder, "x.hdr", "x.pfm") < 0.5
    assert load(folder / "x.tiff").pixels.shape == (3, 64, 64)


def test_wide_gamut(field: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = field / "12-gamut"
    assert jnd(capsys, folder, "acescg-reference.exr", "acescg-test.exr") > 1.0
    assert load(folder / "acescg-reference.exr").pixels.min() < -0.1
    assert jnd(capsys, folder, "chrm.png", "plain.png") > 3.0
