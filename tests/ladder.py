"""Every transform, for tests that hold all of them to the same."""

from torch_vdm.model.cortex import Haar, StationaryHaar, Steerable, Transform

FILTERED: list[Transform] = [Haar("filter"), StationaryHaar("filter")]
TRANSFORMS: list[Transform] = [Haar(), StationaryHaar(), Steerable(), *FILTERED]
