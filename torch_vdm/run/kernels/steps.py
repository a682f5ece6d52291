"""The steps of the model that have kernels."""

from collections.abc import Callable
from typing import Any

from torch_vdm.model.cortex.border import analyse_at_border
from torch_vdm.model.cortex.haar import analyse
from torch_vdm.model.distance import passed_down
from torch_vdm.run.kernels.descent import passed_down_by_kernel
from torch_vdm.run.kernels.haar import analysed, analysed_at_border

# What gives the same as a step of the model, by a kernel.
STEPS: dict[Callable[..., Any], Callable[..., Any]] = {
    analyse: analysed,
    analyse_at_border: analysed_at_border,
    passed_down: passed_down_by_kernel,
}
