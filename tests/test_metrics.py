"""The torchmetrics metric against one pass over everything, in one process and in two."""

import subprocess
import sys
from pathlib import Path
from typing import Literal

import pytest
import torch
from torch import Tensor

from benchmarks.places import ROOT
from torch_vdm import VDM
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
