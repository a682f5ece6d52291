"""The transforms that are measured, by the names that tables give them."""

from torch_vdm import Haar, StationaryHaar
from torch_vdm.cli import TRANSFORMS
from torch_vdm.model.cortex import Transform

# The ladder: what `torch-vdm compare --accuracy` chooses from.
RUNGS: dict[str, Transform] = {name: make() for name, make in TRANSFORMS.items()}

# With those between two rungs, which have an observer of their own too.
ALL: dict[str, Transform] = {
    **RUNGS,
    "stationary": StationaryHaar(),
    "filtered": Haar("filter"),
}
