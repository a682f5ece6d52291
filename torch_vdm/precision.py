"""How precise numbers can be on a device."""

import torch

# Kinds of devices that have no float64; `look_at` adds to them.
_without_float64 = {"mps"}


def widest(device: torch.device) -> torch.dtype:
    """Return float64, or float32 where a device has nothing wider."""
    return torch.float32 if device.type in _without_float64 else torch.float64


def look_at(device: torch.device) -> None:
    """Find out whether a device has float64."""
    try:
        torch.zeros((), dtype=torch.float64, device=device)
    except (TypeError, RuntimeError):  # each kind of device says it in its own way
        _without_float64.add(device.type)
