"""The package as a whole: what importing it brings, and its public names."""

import subprocess
import sys
import tomllib

import torch_vdm
from benchmarks.places import ROOT


def test_heavy_packages_are_imported_where_they_are_used() -> None:
    heavy = {
        *("kornia", "matplotlib", "OpenEXR", "PIL", "rich", "tifffile", "torchmetrics"),
        *("torch._dynamo", "triton"),
    }
    code = f"import sys, torch_vdm; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stdout.decode().strip() == "[]"


def test_the_version_is_the_distributions() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert torch_vdm.__version__ == project["version"]


def test_public_names_exist() -> None:
    assert all(hasattr(torch_vdm, name) for name in torch_vdm.__all__)


def test_modules_that_the_readme_names_come_with_the_package() -> None:
    code = (
        "import sys, torch_vdm; torch_vdm.functional.visual_difference; "
        "assert 'torchmetrics' not in sys.modules; torch_vdm.metrics.VisualDifference"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not hasattr(torch_vdm, "metric")
