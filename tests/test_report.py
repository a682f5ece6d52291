"""What is told of a map."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torch_vdm.report import Comparison, _shrunk_map, figures, shrunk, write_heat_map


def comparison(**changes: object) -> Comparison:
    values: dict[str, object] = {
        "max_jnd": 3.2, "max_pixel": (4, 5), "mean_jnd": 1.0, "p95_jnd": 2.0,
        "visible_fraction": 0.25, "score_jnd": 3.2, "mean_luminance_change": 0.0, "width": 8,
        "height": 9, "ppd": 60.0, "accuracy": "fast", "observer": "calibrated", "effects": [],
        "left_out": [], "seconds": 0.1, "assumptions": [], "version": "0", "reproduce": "",
    }  # fmt: skip
    return Comparison(**values | changes)  # type: ignore[arg-type]  # a dictionary for brevity


def test_figures_are_those_of_numpy() -> None:
    jnd = torch.rand(20, 31, generator=torch.Generator().manual_seed(1)) * 3.0
    values = jnd.numpy()
    told = figures(jnd)
    x, y = told["max_pixel"]
    assert values[y, x] == values.max()
    assert told["max_jnd"] == values.max()
    assert told["mean_jnd"] == pytest.approx(values.mean(dtype=np.float64))
    assert told["p95_jnd"] == np.quantile(values, 0.95, method="inverted_cdf")
    assert told["visible_fraction"] == (values > 1.0).mean()


def test_figures_of_many_bands_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch_vdm.report.BAND", 50)
    for jnd in (torch.rand(37, 20) ** 4, torch.zeros(9, 11), torch.rand(1, 1)):
        values, told = jnd.numpy(), figures(jnd)
        assert told["p95_jnd"] == np.quantile(values, 0.95, method="inverted_cdf")
        y, x = divmod(int(values.argmax()), values.shape[1])
        assert told["max_jnd"] == values.max()
        assert told["max_pixel"] == (x, y)
        assert told["mean_jnd"] == pytest.approx(values.mean(dtype=np.float64))


def test_the_picture_of_a_large_map_keeps_its_largest_value() -> None:
    jnd = torch.zeros(3, 5000)
    jnd[1, 4321] = 7.0
    small = _shrunk_map(jnd)
    assert small.shape == (3, 1000)
    assert small[1, 864] == 7.0
    assert small.sum() == 7.0
    image = torch.rand(3, 7, 2401)
    expected = image[..., :2400].unflatten(-1, (800, 3)).mean(-1)
    torch.testing.assert_close(shrunk(image)[..., :-1], expected)
    torch.testing.assert_close(shrunk(image)[..., -1], image[..., -1])


def test_verdicts() -> None:
    assert "up to 3.2 JND (at x 4, y 5), in 25.0% of the image" in comparison().verdict()
    assert "under 0.1%" in comparison(visible_fraction=1e-4).verdict()
    invisible = comparison(max_jnd=0.9, score_jnd=0.9, visible_fraction=0.0).verdict()
    assert invisible.startswith("Nobody will see a difference at 60 pixels per degree")


@pytest.mark.parametrize("size", [(1, 1), (64, 40), (30, 300), (3, 8192)])
def test_heat_map_is_a_picture(size: tuple[int, int], tmp_path: Path) -> None:
    image = torch.rand(3, *size)
    path = tmp_path / "map.png"
    write_heat_map(path, image, image, torch.rand(size), "a title")
    with Image.open(path) as picture:
        assert min(picture.size) > 100
    assert list(tmp_path.iterdir()) == [path]
