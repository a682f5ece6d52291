"""The training benchmark's own parts: rooms, split, network, seeds, judges and tables."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import training
from benchmarks.judges import judges
from benchmarks.pixels import curve, starts
from benchmarks.renders import (
    CHANNELS,
    GREY,
    LUMINANCE,
    Picture,
    Scene,
    held_out_scenes,
    picture,
    training_scenes,
)
from benchmarks.rooms import room
from benchmarks.unet import UNet, crops, denoise, train
from torch_vdm.model.display import encode_srgb


def pictures(side: int = 24) -> list[Picture]:
    """Return made-up pictures whose albedo has the answer."""
    generator = torch.Generator().manual_seed(1)
    made = []
    for name in "abc":
        clean = 0.2 + 0.5 * torch.rand(3, side // 8, side // 8, generator=generator)
        reference = clean.repeat_interleave(8, -1).repeat_interleave(8, -2)
        noise = torch.rand(2, 3, side, side, generator=generator) * 2.0
        others = torch.rand(2, CHANNELS - 6, side, side, generator=generator)
        planes = (reference * noise, encode_srgb(reference).expand(2, -1, -1, -1), others)
        made.append(Picture(name, torch.cat(planes, 1), reference))
    return made


def weights(network: UNet) -> Tensor:
    return torch.cat([each.detach().flatten() for each in network.parameters()])


def test_no_scene_is_trained_on_and_judged() -> None:
    trained_on, held_out = training_scenes(), held_out_scenes()
    for key in ("name", "source"):
        first, second = ([getattr(each, key) for each in part] for part in (trained_on, held_out))
        assert not set(map(str, first)) & set(map(str, second))
        assert len(set(map(str, first + second))) == len(first) + len(second)


def test_rooms_follow_from_their_seeds() -> None:
    assert room(5) == room(5)
    assert len({room(seed) for seed in range(50)}) == 50


@pytest.mark.usefixtures("mitsuba")
def test_a_room_is_rendered_exposed_and_kept(tmp_path: Path) -> None:
    options = {"side": 12, "takes": 2, "noisy_spp": 4, "reference_spp": 70}
    first = picture(Scene("room 3", room(3)), tmp_path, **options)
    assert first.noisy.shape == (2, CHANNELS, 12, 12)
    assert first.reference.shape == (3, 12, 12)
    assert torch.isfinite(first.noisy).all()
    assert not torch.equal(first.noisy[0, :3], first.noisy[1, :3])
    luminance = np.tensordot(LUMINANCE, first.reference.double().numpy(), 1)
    mean = math.exp(np.log(luminance + 1e-2 * luminance.mean()).mean())
    assert mean == pytest.approx(GREY, rel=1e-3)
    depth = first.noisy[:, -1]
    assert 0.0 <= depth.min() < 0.5 < depth.max() < 1.0
    # Noisy takes are of the same light: within 5 standard errors of all pixels together.
    difference = (first.noisy[:, :3].mean(0) - first.reference).flatten()
    assert abs(difference.mean()) < 5.0 * difference.std() / math.sqrt(len(difference) / 3)
    kept = sorted(tmp_path.iterdir())
    again = picture(Scene("room 3", room(3)), tmp_path, **options)
    assert sorted(tmp_path.iterdir()) == kept
    assert torch.equal(first.noisy, again.noisy)
    assert torch.equal(first.reference, again.reference)


@pytest.mark.parametrize("size", [(1, 1), (3, 9), (16, 16), (21, 34)])
def test_network_takes_any_size(size: tuple[int, int]) -> None:
    assert UNet()(torch.rand(2, CHANNELS, *size)).shape == (2, 3, *size)


def test_network_moves_with_the_picture() -> None:
    # By a pixel of the coarsest level, far from the border, whose padding stays where it is.
    torch.manual_seed(0)
    network = UNet((4, 6, 8)).double()
    noisy = torch.rand(1, CHANNELS, 80, 80, dtype=torch.float64)
    moved = network(noisy.roll((4, 8), (-2, -1)))
    inside = (..., slice(34, 46), slice(34, 46))
    torch.testing.assert_close(moved[inside], network(noisy).roll((4, 8), (-2, -1))[inside])


def test_crops_are_of_one_place_and_repeat() -> None:
    images = [each._replace(noisy=each.noisy.clone()) for each in pictures()]
    for each in images:
        each.noisy[:, :3] = each.reference
    for noisy, reference in crops(images, 3, 5, 16, 4):
        assert noisy.shape == (4, CHANNELS, 16, 16)
        torch.testing.assert_close(encode_srgb(noisy[:, :3]), reference)
    first, again, other = (
        torch.cat([noisy for noisy, _ in crops(images, seed, 2, 16, 2)]) for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_training_repeats() -> None:
    images = pictures()
    first, again, other = (weights(train(training.l1, images, s, 3, 16, 2)) for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_training_lowers_the_loss() -> None:
    images = pictures()
    network = train(training.l1, images, 0, 120, 16, 4)
    noisy = torch.stack([each.noisy[0] for each in images])
    reference = encode_srgb(torch.stack([each.reference for each in images]))
    before = training.l1(encode_srgb(noisy[:, :3]), reference)
    after = training.l1(encode_srgb(denoise(network, noisy)), reference)
    assert after < 0.9 * before


def test_a_trained_network_is_kept_for_its_loss_alone(tmp_path: Path) -> None:
    images = pictures(64)
    first = training.trained("L1", training.l1, images, 0, 2, tmp_path)
    again = training.trained("L1", training.l1, images, 0, 2, tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    assert torch.equal(weights(first), weights(again))
    training.trained("L1", lambda a, b: 2.0 * training.l1(a, b), images, 0, 2, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2


def test_judges_know_equal_and_far() -> None:
    found, missing = judges()
    assert {"JND", "simple"} <= set(found)
    assert not set(found) & set(missing)
    reference = torch.full((1, 3, 32, 32), 0.2)
    equal = {k: v for judge in found.values() for k, v in judge(reference, reference).items()}
    assert (equal["visible"], equal["JND max"], equal["PSNR"]) == (0.0, 0.0, math.inf)
    assert equal["SSIM"] == pytest.approx(1.0)
    far = {k: v for judge in found.values() for k, v in judge(2.0 * reference, reference).items()}
    step = float((encode_srgb(2.0 * reference) - encode_srgb(reference)).mean())
    assert far["PSNR"] == pytest.approx(-20.0 * math.log10(step), rel=1e-5)
    assert far["visible"] == 1.0
    for name, least in (("FLIP", 0.0), ("HDR-FLIP", 0.0)):
        if name in equal:
            assert equal[name] == pytest.approx(least, abs=1e-6)
            assert far[name] > 0.02


def test_a_curve_begins_at_its_start_and_rises() -> None:
    reference = pictures()[0].reference[None].clamp(0.0, 1.0)
    for name, start in starts(reference).items():
        figures = curve(training.l1, start, reference, steps=25, every=10)
        assert figures["step"] == [0, 10, 20, 25], name
        error = (start - reference).square().mean()
        assert figures["PSNR"][0] == pytest.approx(-10.0 * math.log10(error), rel=1e-5)
        assert figures["PSNR"][-1] > figures["PSNR"][0] + 1.0


def test_the_winner_is_the_better_mean() -> None:
    def scenes(share: float, psnr: float) -> dict[str, dict[str, float]]:
        return {"a": {"visible": share, "PSNR": psnr}, "b": {"visible": 0.0, "PSNR": 20.0}}

    result = {
        "losses": {
            "L1": {"seed 0": scenes(0.2, 30.0), "seed 1": scenes(0.4, 30.0)},
            "VDMLoss": {"seed 0": scenes(0.1, 29.0), "seed 1": scenes(0.3, 29.0)},
        }
    }
    assert training.means(result["losses"]["L1"], "visible") == pytest.approx([0.1, 0.2])
    assert training.winner(result, "visible") == "VDMLoss"
    assert training.winner(result, "PSNR") == "L1"


def test_the_example_of_the_docs_runs(capsys: pytest.CaptureFixture[str]) -> None:
    text = (Path(__file__).parent.parent / "docs" / "training.md").read_text()
    code = text.partition("```python\n")[2].partition("```")[0]
    assert code.count("range(300)") == 1
    exec(compile(code.replace("range(300)", "range(30)"), "docs/training.md", "exec"), {})
    noisy, denoised = (
        float(line.partition(": ")[2].partition(" JND")[0])
        for line in capsys.readouterr().out.splitlines()
    )
    assert denoised < noisy
