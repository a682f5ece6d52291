"""The torchmetrics metric against one pass over everything, in one process and in two."""

import subprocess
import sys
from pathlib import Path
from typing import Literal

import pytest
import torch
from torch import Tensor, nn
from torchmetrics import MetricCollection

from benchmarks.places import ROOT
from torch_vdm import VDM, Display, Observer, StationaryHaar
from torch_vdm.metrics import VisualDifference

PROCESS = """
import sys, torch, torch.distributed as dist
from torch_vdm.metrics import VisualDifference
rank, store = int(sys.argv[1]), sys.argv[2]
dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=2)
metric = VisualDifference(40.0)
test, reference = torch.load(sys.argv[3])
# An uneven share: one image here, two there.
share = slice(0, 1) if rank == 0 else slice(1, 3)
metric.update(test[share], reference[share])
if rank == 0:
    print(*(value.item().hex() for value in metric.compute().values()))
else:
    metric.compute()
dist.destroy_process_group()
"""


def images() -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    reference = torch.rand(3, 3, 14, 17, generator=generator)
    noise = 0.05 * torch.randn(reference.shape, generator=generator)
    return (reference + noise).clamp(0.0, 1.0), reference


def expected() -> list[float]:
    test, reference = images()
    jnd = torch.cat([VDM(40.0)(test[i : i + 1], reference[i : i + 1]) for i in range(3)]).double()
    return [jnd.mean().item(), jnd.max().item(), (jnd > 1.0).double().mean().item()]


def test_batches_add_up() -> None:
    test, reference = images()
    metric = VisualDifference(40.0)
    metric.update(test[:1], reference[:1])
    metric.update(test[1:], reference[1:])
    assert list(metric.compute()) == ["mean_jnd", "max_jnd", "visible_fraction"]
    assert [v.item() for v in metric.compute().values()] == pytest.approx(expected(), rel=1e-6)
    metric.reset()
    alone = metric(test, reference)
    assert alone["mean_jnd"].item() == pytest.approx(expected()[0], rel=1e-6)


@pytest.mark.parametrize("figure", ["mean_jnd", "max_jnd", "visible_fraction"])
def test_one_figure_is_a_tensor_that_a_logger_takes(figure: Literal["mean_jnd"]) -> None:
    every, one = VisualDifference(40.0), VisualDifference(40.0, figure=figure)
    every.update(*images())
    one.update(*images())
    found, alone = every.compute(), one.compute()
    assert isinstance(found, dict)
    assert isinstance(alone, Tensor)
    assert torch.equal(alone, found[figure])
    with pytest.raises(ValueError, match="mean_jnd, max_jnd, visible_fraction"):
        VisualDifference(figure="median")  # type: ignore[arg-type]  # wrong on purpose


def test_no_graph_is_kept() -> None:
    test, reference = images()
    metric = VisualDifference(40.0)
    metric.update(test.requires_grad_(), reference)
    assert not any(value.requires_grad for value in metric.compute().values())


def test_two_processes_give_what_one_gives(tmp_path: Path) -> None:
    torch.save(images(), tmp_path / "images.pt")
    command = [sys.executable, "-W", "error", "-c", PROCESS]
    arguments = [str(tmp_path / "store"), str(tmp_path / "images.pt")]
    ranks = [
        subprocess.Popen([*command, str(rank), *arguments], cwd=ROOT, stdout=subprocess.PIPE)
        for rank in (0, 1)
    ]
    outputs = [process.communicate(timeout=120)[0].decode() for process in ranks]
    assert [process.returncode for process in ranks] == [0, 0]
    together = [float.fromhex(word) for word in outputs[0].split()]
    assert together == pytest.approx(expected(), rel=1e-6)


@pytest.mark.parametrize("cast", [torch.bfloat16, torch.float16])
def test_sums_stay_exact_in_a_model_of_low_precision(cast: torch.dtype) -> None:
    # Batches of equal and of different pictures by turns: sums that bfloat16 could not hold.
    metric = VisualDifference(40.0)
    model = nn.ModuleDict({"network": nn.Conv2d(3, 3, 1), "metric": metric})
    model.to(cast)
    black, white = torch.zeros(1, 3, 16, 16, dtype=cast), torch.ones(1, 3, 16, 16, dtype=cast)
    for _ in range(20):
        metric.update(white, white)
        metric.update(white, black)
        model.to(cast)
    found = metric.compute()
    assert isinstance(found, dict)
    assert found["visible_fraction"] == 0.5
    alone = VDM(40.0)(torch.ones(1, 3, 16, 16), torch.zeros(1, 3, 16, 16)).double()
    assert found["mean_jnd"].item() == pytest.approx(0.5 * alone.mean().item(), rel=1e-9)
    # A value that was computed before is not cast either.
    model.to(cast)
    again = metric.compute()
    assert isinstance(again, dict)
    assert again["mean_jnd"] == found["mean_jnd"]
    metric.reset()
    assert metric.jnd.dtype == torch.float64


def test_moves_where_there_is_no_float64() -> None:
    def refused(value: Tensor) -> Tensor:
        if value.dtype == torch.float64:
            raise TypeError("this device has no float64")
        return value.clone()

    metric = VisualDifference(40.0)
    metric.update(*images())
    expected = metric.compute()
    nn.Sequential(metric)._apply(refused)
    assert metric.compute() == expected


def test_metrics_of_other_options_are_never_taken_for_one() -> None:
    # After a batch on which they agree.
    others = {
        "near": VisualDifference(20.0),
        "far": VisualDifference(60.0),
        "bright": VisualDifference(60.0, Display.srgb(500.0)),
        "paper": VisualDifference(60.0, vdm_options={"observer": Observer.paper()}),
        "shifted": VisualDifference(metric=VDM(transform=StationaryHaar())),
        "lubin": VisualDifference(metric=VDM.sarnoff()),
    }
    same = {"largest": VisualDifference(60.0, figure="max_jnd")}
    test, reference = images()
    alone = {name: metric.clone() for name, metric in (others | same).items()}
    together = MetricCollection(others | same)  # type: ignore[arg-type]  # its own dict is invariant
    for first, second in ((test, test), (test, reference)):
        together.update(preds=first, target=second)
        for metric in alone.values():
            metric.update(first, second)
    found = together.compute()
    for name, metric in alone.items():
        expected = metric.compute()
        if isinstance(expected, dict):
            for figure, value in expected.items():
                keys = [key for key in found if figure in key and name in key]
                assert all(torch.equal(found[key], value) for key in keys)
        else:
            assert torch.equal(found[name], expected)
    assert len(together.compute_groups) == len(others)


def test_takes_a_metric_in_place_of_options() -> None:
    test, reference = images()
    metric = VisualDifference(metric=VDM.paper(40.0), figure="max_jnd")
    metric.update(preds=test, target=reference)
    found = metric.compute()
    assert isinstance(found, Tensor)
    assert found.item() == pytest.approx(VDM.paper(40.0)(test, reference).max().item())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"metric": VDM}, "a metric such as VDM"),
        ({"metric": VDM(), "ppd": 30.0}, "a metric or options for one, got both"),
        ({"metric": VDM(), "vdm_options": {}}, "a metric or options for one, got both"),
        ({"vdm_options": "paper"}, "vdm_options: a dictionary"),
        ({"figure": ["mean_jnd"]}, "a figure of"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VisualDifference(**options)  # type: ignore[arg-type]  # wrong on purpose


def test_a_plot_is_bounded_by_what_a_figure_can_be() -> None:
    import matplotlib as mpl

    mpl.use("agg")
    metric = VisualDifference(40.0, figure="visible_fraction")
    metric.update(*images())
    figure, axes = metric.plot()
    low, high = axes.get_ylim()
    assert low <= 0.0
    assert 1.0 <= high < 1.5
    figure.clear()
    assert VisualDifference(40.0).plot_upper_bound is None
