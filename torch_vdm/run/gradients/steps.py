"""The steps of the model that have gradients by hand."""

from collections.abc import Callable
from typing import Any

from torch_vdm.model.cones import pixels_to_cones
from torch_vdm.model.cortex.border import analyse_at_border
from torch_vdm.model.cortex.haar import analyse
from torch_vdm.model.display import linear_values
from torch_vdm.model.distance import passed_down
from torch_vdm.run.gradients.analysis import analysed, analysed_at_border
from torch_vdm.run.gradients.descent import passed_down_by_hand
from torch_vdm.run.gradients.light import cones_by_hand, linear_by_hand

# What gives the same as a step of the model, with its gradient by hand.
STEPS: dict[Callable[..., Any], Callable[..., Any]] = {
    linear_values: linear_by_hand,
    pixels_to_cones: cones_by_hand,
    analyse: analysed,
    analyse_at_border: analysed_at_border,
    passed_down: passed_down_by_hand,
}
