"""The steps of the model that have kernels."""

from collections.abc import Callable
from typing import Any

from torch_vdm.model.cortex.border import analyse_at_border
from torch_vdm.model.cortex.haar import analyse
from torch_vdm.run.kernels.haar import analysed, analysed_at_border

# What gives the same as a step of the model, by a kernel; of `analyse_at_border` as `Steps.padded`
# calls it, with planes that are not padded yet.
STEPS: dict[Callable[..., Any], Callable[..., Any]] = {
    analyse: analysed,
    analyse_at_border: analysed_at_border,
}
