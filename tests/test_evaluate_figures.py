"""What is known of one frame: places, counts, pictures, flicker, peers."""

import base64
import math
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from torch_vdm import VDM, Display
from torch_vdm.evaluate import flicker, maps, peers, pictures
from torch_vdm.model.display import decode_srgb, encode_srgb


def unpacked(path: Path) -> tuple[str, NDArray[np.uint8]]:
    """Read a picture as the page does: its kind and its planes."""
    found = re.fullmatch(r'picture\("(\w+)",(\d+),(\d+),"(\w+)","([\w+/=]+)"\)\n', path.read_text())
    assert found is not None
    assert found[1] == path.stem
    width, height = int(found[2]), int(found[3])
    steps = np.frombuffer(zlib.decompress(base64.b64decode(found[5])), np.uint8)
    return found[4], np.cumsum(steps.reshape(-1, height, width), 2, dtype=np.uint8)


def test_counts_are_of_all_pixels() -> None:
    jnd = torch.tensor([[0.0, 0.01, 1.0, 1.001], [1e5, 129.0, 0.5, 0.0625]])
    counts = maps.counts(jnd)
    assert sum(counts) == jnd.numel()
    assert counts[0] == 3  # with what lies on the lowest border
    at_one = maps.BORDERS.index(1.0)
    assert sum(counts[at_one + 1 :]) == 3  # over 1 JND
    assert counts[-1] == 2


def test_regions_are_the_worst_places() -> None:
    jnd = torch.zeros(100, 150)
    jnd[40, 60], jnd[42, 66], jnd[0, 149], jnd[99, 0] = 5.0, 4.9, 3.0, 1.0
    found = maps.regions(jnd, ppd=20.0)
    assert [region[4] for region in found] == [5.0, 3.0, 1.0]
    assert found[0][:4] == (50, 30, 20, 20)
    assert found[1][:4] == (130, 0, 20, 20)
    assert found[2][:4] == (0, 80, 20, 20)
    assert maps.regions(torch.zeros(5, 5), ppd=60.0) == []
    assert maps.regions(torch.ones(1, 1), ppd=60.0) == [(0, 0, 1, 1, 1.0)]
    assert len(maps.regions(torch.rand(400, 400), ppd=16.0)) == maps.REGIONS


def test_a_map_keeps_its_values_to_a_hundredth(tmp_path: Path) -> None:
    jnd = torch.rand(7, 9) * 5.0
    jnd[0, 0], jnd[1, 1], jnd[2, 2] = 0.0, 99999.99, 700.126
    kind, planes = unpacked(pictures.path_of(tmp_path, pictures.write_map(tmp_path, jnd)))
    value = planes[0] * 65536.0 + planes[1] * 256.0 + planes[2]
    assert kind == "map"
    assert np.abs(value / 100.0 - jnd.numpy()).max() <= 0.0051


def test_light_keeps_its_values_to_8_bits_of_the_largest_channel(tmp_path: Path) -> None:
    light = torch.rand(3, 6, 5) * torch.logspace(-6, 5, 30).view(6, 5)
    light[:, 0, 0], light[0, 1, 1] = 0.0, -3.0
    name = pictures.write_image(tmp_path, light, coded=False)
    kind, planes = unpacked(pictures.path_of(tmp_path, name))
    shown = planes[:3] * np.exp2(planes[3].astype(float) - 136.0)
    assert kind == "light"
    expected = light.clamp_min(0.0).numpy()
    assert (np.abs(shown - expected) <= expected.max(0) / 255.0 + 1e-38).all()


def test_coded_images_keep_their_bytes(tmp_path: Path) -> None:
    codes = torch.arange(256, dtype=torch.float32).view(1, 16, 16).expand(3, -1, -1) / 255.0
    name = pictures.write_image(tmp_path, decode_srgb(codes), coded=True)
    kind, planes = unpacked(pictures.path_of(tmp_path, name))
    assert kind == "coded"
    assert (planes == np.arange(256).reshape(16, 16)).all()


def test_the_same_picture_is_written_once(tmp_path: Path) -> None:
    image = torch.rand(3, 4, 4)
    name = pictures.write_image(tmp_path, image, coded=True)
    before = pictures.path_of(tmp_path, name).stat().st_mtime_ns
    assert pictures.write_image(tmp_path, image.clone(), coded=True) == name
    assert pictures.path_of(tmp_path, name).stat().st_mtime_ns == before
    assert len(list(tmp_path.iterdir())) == 1


def test_large_images_are_shown_by_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "LARGEST_SIDE", 8)
    assert pictures.block((8, 8)) == 1
    assert pictures.block((17, 3)) == 3
    jnd = torch.zeros(17, 3)
    jnd[16, 2] = 2.0
    _, planes = unpacked(pictures.path_of(tmp_path, pictures.write_map(tmp_path, jnd)))
    assert planes.shape == (3, 6, 1)
    assert planes[2, 5, 0] == 200
    _, planes = unpacked(
        pictures.path_of(tmp_path, pictures.write_image(tmp_path, torch.ones(3, 17, 3), True))
    )
    assert planes.shape == (3, 6, 1)
    assert planes.min() == 255


def moving() -> tuple[Tensor, Tensor, Tensor]:
    """Return two references, and an error that fits both."""
    generator = torch.Generator().manual_seed(1)
    base = torch.rand(3, 24, 40, generator=generator)
    return base[..., :32], base[..., 8:], 0.1 * torch.rand(3, 24, 32, generator=generator)


def test_an_error_that_stays_does_not_flicker() -> None:
    before, now, error = moving()
    metric = VDM(30.0, Display.linear(100.0))
    expected = flicker.with_error_of_before(now, now + error, before, before + error)
    assert metric((now + error)[None], expected[None]).max() < 1e-2
    expected = flicker.with_error_of_before(now, now, before, before)
    assert metric(now[None], expected[None]).max() == 0.0


def test_an_error_that_changes_flickers() -> None:
    before, now, error = moving()
    metric = VDM(30.0, Display.linear(100.0))
    expected = flicker.with_error_of_before(now, now + error.flip(-1), before, before + error)
    assert metric((now + error.flip(-1))[None], expected[None]).max() > 0.5


def test_light_that_is_not_there_is_not_taken_away() -> None:
    zero, one = torch.zeros(3, 2, 2), torch.ones(3, 2, 2)
    assert (flicker.with_error_of_before(zero, zero, one, zero) == 0.0).all()
    assert (flicker.with_error_of_before(-one, -one, one, one) == -1.0).all()


def test_peers_say_what_they_say_elsewhere() -> None:
    from kornia.metrics import ssim

    generator = torch.Generator().manual_seed(2)
    for size in ((32, 40), (11, 11), (13, 30), (15, 12)):
        reference = torch.rand(3, *size, generator=generator)
        test = reference * 0.9
        names = ("psnr", "ssim", "flip")
        values, notes = peers.judged(names, test, reference, 60.0, 100.0)
        assert notes == []
        coded = [encode_srgb(image) for image in (test, reference)]
        error = (coded[0] - coded[1]).square().mean().item()
        assert values["psnr"] == pytest.approx(-10.0 * math.log10(error), rel=1e-5)
        one, other = (torch.tensordot(torch.tensor(peers.LUMA), each, 1) for each in coded)
        whole = ssim(one[None, None], other[None, None], 11, padding="valid").mean().item()
        assert values["ssim"] == pytest.approx(whole, rel=1e-5)
        assert values["flip"] is not None
        assert 0.0 < values["flip"] < 0.3


def test_peers_of_equal_and_of_small_images() -> None:
    image = torch.rand(3, 12, 12)
    values, _ = peers.judged(("psnr", "ssim"), image, image, 60.0, 100.0)
    assert values == {"psnr": None, "ssim": pytest.approx(1.0)}
    values, notes = peers.judged(("psnr", "ssim"), image[:, :3], 0.5 * image[:, :3], 60.0, 100.0)
    assert values["ssim"] is None
    assert values["psnr"] is not None
    assert notes == ["no ssim: expected 11 pixels a side or more"]
