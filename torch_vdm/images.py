"""What images may be, and what is done if they are not: messages, and repairs of pixels."""

import sys

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import is_fake
from torch.nn import functional

from torch_vdm.model.quadtree import push

# An image with a higher sRGB code than this, or a larger share of values below the lowest, is taken
# not to be sRGB-coded: filters and noise leave less. Status: choice.
HIGHEST_CODE, LOWEST_CODE, MOST_BELOW = 2.0, -0.1, 0.05

# Pixels a side of the largest square whose mean replaces a pixel that is finite in neither image.
# Status: choice.
SQUARE = 64


def refuse_onnx() -> None:
    """Raise if a graph is made for ONNX."""
    # Not imported just to ask.
    onnx = None if torch.compiler.is_dynamo_compiling() else sys.modules.get("torch.onnx")
    if onnx is not None and onnx.is_in_onnx_export():
        raise ValueError(
            "expected no export to ONNX, which lacks operators that the metric needs; "
            "use torch.export.export"
        )


def remedy(shape: tuple[int, ...]) -> str:
    """Return what to do with an image of the wrong shape, as the end of a message."""
    if 0 in shape:
        return ""
    match shape:
        case (3, _, _):
            return "; give it a batch of one, image[None]"
        case (_, 1, _, _):
            return "; repeat the channel of a grey image, image.expand(-1, 3, -1, -1)"
        case (*_, _, _, 3):
            return "; put channels first, image.movedim(-1, -3), in (B, 3, H, W)"
        case (_, 4, _, _):
            return "; composite it and leave out alpha, image[:, :3]"
        case (_, _) | (1, _, _):
            return "; repeat a grey image as three channels, image.expand(1, 3, -1, -1)"
        case _:
            return ""


def has_values(image: Tensor) -> bool:
    """Return whether there are values to read, which a meta or a fake tensor lacks."""
    return not (image.is_meta or is_fake(image))


def can_be_read(image: Tensor) -> bool:
    """Return whether values can be read back here, and are an image's own."""
    return not (
        torch.compiler.is_compiling()
        or not has_values(image)
        or torch._C._are_functorch_transforms_active()
        or (image.is_cuda and torch.cuda.is_current_stream_capturing())
    )


def is_queued(image: Tensor) -> bool:
    """Return whether its device computes while Python goes on, so that reading a value waits."""
    return image.device.type not in ("cpu", "meta")


def require_finite(test: Tensor, reference: Tensor, origin: tuple[int, int, int]) -> None:
    """Raise if an image has NaN or infinity, naming the first such item and pixel."""
    images = {"test": test.detach(), "reference": reference.detach()}
    # One cheap pass, and one number: the sum of an image that is not finite is not finite either.
    first, second = (image.sum() for image in images.values())
    if bool(torch.isfinite(first + second)):
        return
    for name, image in images.items():
        _require_finite(name, image, origin)


def _require_finite(name: str, image: Tensor, origin: tuple[int, int, int]) -> None:
    bad = ~torch.isfinite(image)
    if not bool(bad.any()):
        return
    item = int(bad.flatten(1).any(1).nonzero()[0])
    channel, y, x = bad[item].nonzero()[0].tolist()
    raise ValueError(
        f"expected finite pixel values, got {int(bad[item].sum())} NaN or infinite ones in the "
        f"{name}'s batch item {item + origin[0]}, the first in channel {channel} "
        f"at x {x + origin[2]}, y {y + origin[1]}; "
        'repair them or pass nonfinite="mask"'
    )


def range_of(image: Tensor) -> Tensor:
    """Return an image's lowest and highest value, and the share of those below `LOWEST_CODE`."""
    image = image.detach()
    below = (image < LOWEST_CODE).to(image).mean()
    return torch.stack([image.amin(), image.amax(), below])


def advice(high: bool, low: bool) -> str:
    """Return what to do with values out of range, as a part of a message."""
    if high and low:
        return "undo its normalisation"
    if high:
        return "divide 8-bit values by 255, or give light a Display.linear or Display.xyz"
    return "take (image + 1) / 2 of values in [-1, 1]"


def masked(plane: Tensor, seen: Tensor | None) -> Tensor:
    """Return a plane with 0 where a mask (B, 1, H, W) is not set."""
    return plane if seen is None else torch.where(seen, plane, 0.0)


def finite_in_both(test: Tensor, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both images, equal where a channel of either is not finite, and where all are finite.

    They are (B, 3, H, W) twice, and (B, 1, H, W), boolean. A pixel that is finite in one image is
    taken for both. One that is finite in neither gets the mean of the smallest square around it
    with a finite pixel, of 2, 4 ... `SQUARE` pixels a side from the image's corner, so that it
    masks nothing around it.
    """
    images = torch.stack((test.detach(), reference.detach()))
    finite = torch.isfinite(images).all(2, keepdim=True)
    known = torch.where(finite, images, 0.0)
    # Sums over both images, and how many are finite: of squares both become means, by one ratio.
    sums = torch.cat((known, finite.to(known)), 2).mean(0)
    value, either, seen = torch.where(finite[0], known[0], known[1]), finite.any(0), finite.all(0)
    filled = torch.where(either, value, _around(sums, SQUARE))
    return torch.where(seen, test, filled), torch.where(seen, reference, filled), seen


def _around(sums: Tensor, side: int) -> Tensor:
    """Return at every pixel the mean of the smallest square with a finite pixel; 0 if none has one.

    ``sums`` (B, C + 1, h, w): the sum of the finite pixels of each square, and their number, the
    last channel, both divided by the same. The largest square has ``side`` pixels a side.
    """
    total, count = sums[:, :-1], sums[:, -1:]
    if side == 1:
        return torch.where(count > 0.0, total / count, 0.0)
    wider = _around(functional.avg_pool2d(sums, 2, ceil_mode=True, divisor_override=4), side // 2)
    wider = push(wider, (sums.shape[-2], sums.shape[-1]))
    return torch.where(count > 0.0, total / count, wider)
