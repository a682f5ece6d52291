"""What every result carries: the machine, the versions, the date and the command."""

import datetime
import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

import torch_vdm
from benchmarks.places import ROOT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PACKAGES = ("torch", "kornia", "numpy")


def circumstances() -> dict[str, Any]:
    """Return what a figure depends on besides the code."""
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "command": " ".join(["python -m benchmarks", *_arguments()]),
        "machine": {
            "processor": _processor(),
            "threads": torch.get_num_threads(),
            "system": f"{platform.system()} {platform.machine()}",
        },
        "versions": {
            "torch_vdm": torch_vdm.__version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in PACKAGES},
        },
    }


def _arguments() -> list[str]:
    """Return the command's arguments but for where results go, on which no figure depends."""
    words = sys.argv[1:]
    if "--output" in words:
        place = words.index("--output")
        del words[place : place + 2]
    return words


def caption(result: dict[str, Any]) -> str:
    """Return one line that says where and when a result was measured."""
    machine, versions = result["machine"], result["versions"]
    return (
        f"{machine['processor']}, {machine['threads']} threads, torch {versions['torch']}, "
        f"kornia {versions['kornia']}, {result['date']}: `{result['command']}`"
    )


def save(folder: Path, name: str, result: dict[str, Any], table: str) -> None:
    """Write ``name.json`` and ``name.md``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(result, indent=2) + "\n")
    (folder / f"{name}.md").write_text(table)


def source() -> str:
    """Return a hash of the packages' code, on which what is kept of an earlier run depends."""
    digest = hashlib.sha256()
    for folder in ("torch_vdm", "sampling"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def measured_apart(
    module: str, *arguments: object, environment: dict[str, str] | None = None
) -> dict[str, float]:
    """Return what a benchmark's module prints last, JSON, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{module}", *map(str, arguments)],
        env=os.environ | (environment or {}),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        check=True,
    )
    figures: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return figures


def in_turn(names: Iterable[str], number: int) -> list[str]:
    """Return names in order, or every second time from the last to the first.

    None then always runs in what the same other one leaves behind.
    """
    each = list(names)
    return each[::-1] if number % 2 else each


def blank_figure(width: float, height: float, dpi: int = 150) -> "Figure":
    """Return an empty figure of so many inches; `savefig` writes it."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=dpi, layout="constrained")


def _processor() -> str:
    """Return the processor's name as the system gives it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
