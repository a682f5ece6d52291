"""The JND meter for images that are computed: a visual difference metric in PyTorch."""

from importlib import import_module
from typing import Any

from torch_vdm import functional
from torch_vdm.effects import Effects
from torch_vdm.io import ImageError, read_image, write_image
from torch_vdm.loss import VDMLoss
from torch_vdm.model.cortex import Haar, StationaryHaar, Steerable
from torch_vdm.model.display import Display, pixels_per_degree
from torch_vdm.observer import Observer
from torch_vdm.vdm import VDM

__version__ = "0.1.0"

__all__ = [
    "VDM",
    "Display",
    "Effects",
    "Haar",
    "ImageError",
    "Observer",
    "StationaryHaar",
    "Steerable",
    "VDMLoss",
    "functional",
    "pixels_per_degree",
    "read_image",
    "write_image",
]


def __getattr__(name: str) -> Any:
    """Import `torch_vdm.metrics` where it is asked for: torchmetrics is optional, and large."""
    if name == "metrics":
        return import_module("torch_vdm.metrics")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
