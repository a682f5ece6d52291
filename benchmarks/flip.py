"""NVIDIA's FLIP, of the package flip-evaluator: importing this fails where it is missing."""

from typing import Literal

import flip_evaluator
import numpy as np
import torch
from torch import Tensor


def flip(
    test: Tensor, reference: Tensor, ppd: float, kind: Literal["LDR", "HDR"] = "LDR"
) -> Tensor:
    """Return the error map (H, W) of two images (3, H, W), 0 to 1.

    sRGB-coded for "LDR", light over white for "HDR"; ``ppd`` is in pixels per degree.
    """
    images = (
        np.ascontiguousarray(image.permute(1, 2, 0).float().numpy()) for image in (reference, test)
    )
    found, *_ = flip_evaluator.evaluate(*images, kind, applyMagma=False, parameters={"ppd": ppd})
    error: Tensor = torch.from_numpy(found)[..., 0]
    return error
