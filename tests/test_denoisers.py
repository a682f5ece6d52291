"""The denoisers' benchmark: what denoises, who judges, and how converged a reference is."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from benchmarks import denoisers
from benchmarks.judges import PPD, WHITE
from benchmarks.renders import CHANNELS
from torch_vdm import VDM, Display, StationaryHaar, write_image
from torch_vdm.model.display import encode_srgb


def shot(side: int = 48) -> tuple[Tensor, Tensor]:
    """Return a made-up render (10, H, W) and its light (3, H, W): two walls and a lamp."""
    generator = torch.Generator().manual_seed(3)
    light = torch.full((3, side, side), 0.2)
    light[:, :, side // 2 :] = torch.tensor([0.5, 0.3, 0.1])[:, None, None]
    light[:, 4:10, 4:10] = 20.0
    noise = torch.rand(1, side, side, generator=generator) - 0.5
    planes = torch.zeros(CHANNELS, side, side)
    planes[:3] = light * (1.0 + 0.6 * noise)
    planes[3:6] = light.clamp(0.0, 1.0)
    planes[8] = 1.0
    return planes, light


@pytest.mark.parametrize("name", list(denoisers.FOLDERS))
def test_a_denoiser_takes_noise_and_keeps_light(tmp_path: Path, name: str) -> None:
    found, missing = denoisers.denoisers(tmp_path)
    if name not in found:
        pytest.skip(f"{missing}")
    planes, light = shot()
    before = planes.clone()
    clean = found[name](planes)
    assert torch.equal(planes, before)
    assert (clean.shape, clean.dtype) == (light.shape, torch.float32)
    assert float(clean.min()) >= 0.0
    # A lamp 20 times as bright as white is neither cut off nor taken for a firefly.
    assert float(clean[:, 6:8, 6:8].mean()) == pytest.approx(20.0, rel=0.3)
    error = [
        float((encode_srgb(each) - encode_srgb(light)).abs().mean()) for each in (clean, light)
    ]
    noisy = float((encode_srgb(planes[:3]) - encode_srgb(light)).abs().mean())
    assert error[1] == 0.0
    assert error[0] == pytest.approx(noisy) if name == denoisers.NOISY else error[0] < 0.8 * noisy


def test_what_is_not_installed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    found, missing = denoisers.denoisers(tmp_path)
    assert list(found) == [denoisers.NOISY]
    assert "torch-vdm[denoise]" in missing["Open Image Denoise"]
    assert set(missing) == {"bilateral, non-local means", "Open Image Denoise", "U-Net"}


def test_evaluate_is_the_judge(tmp_path: Path) -> None:
    planes, light = shot()
    for folder, image in (("reference", light), ("noisy", planes[:3])):
        (tmp_path / folder).mkdir()
        write_image(tmp_path / folder / "walls.exr", image)
    told = denoisers.judged(tmp_path / "reference", {"noisy": tmp_path / "noisy"})
    (frame,) = told["frames"]
    display = Display.linear(WHITE)
    metric = VDM(PPD, display, transform=StationaryHaar(csf="filter"))
    jnd = metric(planes[None, :3], light[None])
    assert frame["figures"]["max_jnd"] == pytest.approx(float(jnd.max()), rel=1e-5)
    assert frame["figures"]["mean_jnd"] == pytest.approx(float(jnd.mean()), rel=1e-5)
    with pytest.raises(RuntimeError, match="expected a folder"):
        denoisers.judged(tmp_path / "none", {"noisy": tmp_path / "noisy"})


def test_halves_tell_the_error_of_their_mean(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(5)
    truth = torch.full((3, 96, 96), 0.2)
    # As faint as a reference's: strong noise hides some of its own difference, in a half the more.
    halves = [truth * (1.0 + 0.02 * torch.randn(truth.shape, generator=generator)) for _ in "ab"]
    for name, image in zip(("one", "other"), halves, strict=True):
        (tmp_path / "halves" / name).mkdir(parents=True)
        write_image(tmp_path / "halves" / name / "wall.exr", image)
    for folder, image in (("truth", truth), ("reference", 0.5 * (halves[0] + halves[1]))):
        (tmp_path / folder).mkdir()
        write_image(tmp_path / folder / "wall.exr", image)
    known = denoisers.judged(tmp_path / "truth", {"A": tmp_path / "reference"})["frames"][0]
    told = denoisers._own_error(tmp_path)["wall"]
    for name, value in told.items():
        # The largest of a noise scatters most.
        within = 0.5 if name == "max_jnd" else 0.25
        assert value == pytest.approx(known["figures"][name], rel=within), name


def test_the_best_is_bold_and_what_lacks_is_empty() -> None:
    column = {"a": 0.5, "b": 0.25, "c": None}
    assert denoisers._cell(column, "b", 2, more=False) == "**0.25**"
    assert denoisers._cell(column, "a", 2, more=False) == "0.50"
    assert denoisers._cell(column, "a", 1, more=True) == "**0.5**"
    assert denoisers._cell(column, "c", 2, more=True) == ""
    scenes: dict[str, dict[str, Any]] = {"x": {"psnr": 30.0}, "y": {"psnr": 40.0}}
    assert denoisers.mean(scenes, "psnr") == 35.0
    assert denoisers.mean(scenes | {"z": {"psnr": None}}, "psnr") is None
