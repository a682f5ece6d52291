"""The precision of numbers: on a device, and for two images."""

import torch

# Types of devices that have no float64; `look_at` adds to them.
_without_float64 = {"mps"}


def widest(device: torch.device) -> torch.dtype:
    """Return float64, or float32 if the device has nothing wider."""
    return torch.float32 if device.type in _without_float64 else torch.float64


def computed_in(test: torch.Tensor, reference: torch.Tensor) -> torch.dtype:
    """Return the precision in which two images are compared: float64 if one has it."""
    return torch.float64 if torch.float64 in (test.dtype, reference.dtype) else torch.float32


def look_at(device: torch.device) -> None:
    """Find out whether a device has float64."""
    try:
        torch.zeros((), dtype=torch.float64, device=device)
    except (TypeError, RuntimeError):  # each type of device says it in its own way
        _without_float64.add(device.type)
