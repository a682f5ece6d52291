"""What every result carries: the machine, the versions, the date and the command."""

import datetime
import importlib.metadata
import json
import platform
import sys
from pathlib import Path
from typing import Any

import torch

import torch_vdm

PACKAGES = ("torch", "kornia", "numpy")


def circumstances() -> dict[str, Any]:
    """Return what a figure depends on besides the code."""
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "command": " ".join(["python -m benchmarks", *sys.argv[1:]]),
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


def _processor() -> str:
    """Return the processor's name as the system gives it."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
