"""The visible change of the error from one frame of a sequence to the next."""

import torch
from torch import Tensor


def with_error_of_before(
    reference: Tensor, test: Tensor, reference_before: Tensor, test_before: Tensor
) -> Tensor:
    """Return the test as it would be with the error of the frame before.

    The error is test minus reference, in linear light. The metric between the test and this image
    measures how the error changed, and not how the scene moved: it is 0 for an error that stays,
    and for a test that equals its reference in both frames.

    Parameters
    ----------
    reference, test
        (3, H, W), linear light of the frame.
    reference_before, test_before
        The same of the frame before.

    Returns
    -------
    Tensor
        (3, H, W). Where the old error would remove more light than there is, it is 0, or the test's
        own value where that is below 0.
    """
    expected = reference + (test_before - reference_before)
    return torch.maximum(expected, test.clamp_max(0.0))
