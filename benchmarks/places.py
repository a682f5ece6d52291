"""Where things are that benchmarks read and keep."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# What costs much to make again: references, renders, runs. Not in the repository.
CACHE = ROOT / "benchmarks" / "cache"


def shared_data() -> Path:
    """Return the folder of shared data, which need not be there."""
    return Path(os.environ.get("TORCH_VDM_DATA", ROOT.parent / "shared" / "data"))
