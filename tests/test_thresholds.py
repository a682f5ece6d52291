"""Human thresholds: the stimuli as light, and that the calibrated observer sees them so."""

import math
import statistics

import pytest
import torch

from benchmarks.thresholds import Threshold, background, pattern, read_thresholds, render, sampling
from torch_vdm import VDM, Display
from torch_vdm.model.cones import XYZ_TO_SML

ROWS = read_thresholds()


def test_the_table_is_whole() -> None:
    assert len(ROWS) == 1036
    assert len({t.study for t in ROWS}) == 8


@pytest.mark.parametrize("row", [0, 130, 400, 900])
def test_light_has_the_stated_contrast_and_luminance(row: int) -> None:
    threshold = ROWS[row]
    drawn = pattern(threshold, sampling(threshold, 8.0), 0.4)
    light = render(threshold, drawn, 1.0)[0]
    cones = torch.einsum("ij,jhw->ihw", torch.tensor(XYZ_TO_SML).double(), light)
    contrast = cones / background(threshold.luminance).view(3, 1, 1) - 1.0
    expected = torch.tensor(threshold.contrast).double().view(3, 1, 1) * drawn
    torch.testing.assert_close(contrast, expected, rtol=1e-9, atol=1e-12)
    flat = render(threshold, drawn, 0.0)[0, 1]
    torch.testing.assert_close(flat, torch.full_like(flat, threshold.luminance))


def test_a_gabor_patch_has_its_frequency_and_size() -> None:
    patch = Threshold(0, "", "", "", 4.0, 3.14, 0.5, 50.0, (0.01,) * 3, "gabor", 90.0)
    drawn = pattern(patch, 32.0, 0.0)
    power = torch.fft.fft2(drawn).abs()[: drawn.shape[0] // 2, 0]
    assert power.argmax() * 32.0 / drawn.shape[0] == pytest.approx(4.0, abs=0.3)
    # The integral of a squared Gabor patch: half that of a squared Gaussian.
    area = float((drawn**2).sum()) / 32.0**2
    assert area == pytest.approx(0.5 * math.pi * 0.5**2, rel=0.02)


@pytest.mark.parametrize("mechanism", ["achromatic", "red-green", "yellow-violet"])
def test_human_thresholds_score_about_1(mechanism: str) -> None:
    # Medians are known to about 10 %; the fit leaves studies their own gains.
    rows = [t for t in ROWS if t.mechanism == mechanism and t.stimulus != "disk"]
    scores = []
    for threshold in rows[::5]:
        ppd = sampling(threshold, 8.0)
        drawn = pattern(threshold, ppd, 0.4)
        images = (render(threshold, drawn, times).float() for times in (1.0, 0.0))
        scores.append(VDM(ppd, Display.xyz()).score(*images).item())
    assert statistics.median(scores) == pytest.approx(1.0, abs=0.35)
