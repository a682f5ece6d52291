"""Cortex filtering, the second box of Fig. 2: an image as frequency and orientation channels."""

from torch_vdm.model.cortex.haar import Haar
from torch_vdm.model.cortex.stationary import StationaryHaar
from torch_vdm.model.cortex.steerable import Steerable
from torch_vdm.model.cortex.transform import DEEPEST, Cortex, Transform

__all__ = ["DEEPEST", "Cortex", "Haar", "StationaryHaar", "Steerable", "Transform"]
