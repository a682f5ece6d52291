"""Pictures next to the page, which keep values: the page reads numbers, not colours.

A browser hides the pixels of a picture file from a page that was opened from a disk, and may change
their colours. So each picture is a script that calls ``picture(name, width, height, kind, data)``;
data is base64 of deflated planes of bytes, each byte the difference from its left neighbour, modulo
256.

=======  ======================================================================
kind     planes of (height, width)
=======  ======================================================================
coded    R, G, B, sRGB-coded
light    R, G, B and a common exponent e: the light is R * 2^(e - 136), 1.0 is white
map      hundredths of a JND as a whole number, its high, middle and low byte
=======  ======================================================================
"""

import base64
import hashlib
from pathlib import Path

import numpy as np
import torch
from isal import isal_zlib
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from torch_vdm.io import atomic_path
from torch_vdm.model.display import encode_srgb
from torch_vdm.report import SMALLEST_SCALE

# Largest side of a picture on the page, in pixels; larger images are shown in blocks of pixels.
# A browser's canvas takes more, but not much. Status: choice.
LARGEST_SIDE = 4096

# Largest side of the thumbnails of maps, in pixels. Status: choice.
THUMBNAIL = 320

# Steps per JND: the page prints hundredths. Status: choice.
STEPS = 100

# Of a picture of light; darker light is black. With it 2^(8 - e) is a float. Status: derived.
SMALLEST_EXPONENT = -119

# Compression level of pictures, 0 to 3: a higher one gains little on noise. Status: choice.
LEVEL = 1

Bytes = NDArray[np.uint8]


def block(size: tuple[int, int]) -> int:
    """Return the side of the blocks of pixels in which an image (height, width) is shown."""
    return -(-max(size) // LARGEST_SIDE)


def write_image(folder: Path, light: Tensor, coded: bool) -> str:
    """Write a picture of an image and return its name.

    Parameters
    ----------
    folder
        The folder to write to.
    light
        (3, H, W), linear, 1.0 is white; light below 0 is shown as 0.
    coded
        Whether 8-bit sRGB codes hold it, because it came from such a file.
    """
    step = block((light.shape[-2], light.shape[-1]))
    if step > 1:
        light = functional.avg_pool2d(light[None], step, ceil_mode=True, count_include_pad=False)[0]
    if coded:
        planes = encode_srgb(light).clamp(0.0, 1.0).mul(255.0).round().to(torch.uint8).numpy()
        return _write(folder, "coded", planes)
    return _write(folder, "light", _with_common_exponent(light.numpy()))


def write_map(folder: Path, jnd: Tensor) -> str:
    """Write a picture of a map (H, W) in JND and return its name; a block shows its maximum."""
    step = block((jnd.shape[0], jnd.shape[1]))
    if step > 1:
        jnd = functional.max_pool2d(jnd[None, None], step, ceil_mode=True)[0, 0]
    whole = np.minimum(np.rint(jnd.double().numpy() * STEPS), 2**24 - 1).astype(np.uint32)
    planes = np.stack([whole >> 16, whole >> 8, whole]).astype(np.uint8)
    return _write(folder, "map", planes)


def write_thumbnail(path: Path, jnd: Tensor) -> None:
    """Draw a map (H, W) as a small PNG in its colours; a block of pixels shows its maximum."""
    import PIL.Image

    step = -(-max(jnd.shape) // THUMBNAIL)
    small = functional.max_pool2d(jnd[None, None], step, ceil_mode=True)[0, 0]
    top = max(SMALLEST_SCALE, small.max().item())
    picture = PIL.Image.fromarray((small / top * 255.0).round().to(torch.uint8).numpy())
    picture.putpalette(palette().tobytes())
    with atomic_path(path) as temporary:
        picture.save(temporary, "PNG")


def palette() -> Bytes:
    """Return the colours of a map from 0 to the top of its scale, (256, 3)."""
    from matplotlib import colormaps

    colours: Bytes = colormaps["inferno"](np.arange(256), bytes=True)[:, :3]
    return np.ascontiguousarray(colours)


def path_of(folder: Path, name: str) -> Path:
    """Return the file of a picture."""
    return folder / f"{name}.js"


def _with_common_exponent(light: NDArray[np.float32]) -> Bytes:
    """Return bytes of R, G, B and their exponent (4, H, W): Radiance's RGBE, value for value."""
    light = np.maximum(light, np.float32(0.0))
    largest = light.max(0)
    # The same as `numpy.frexp` and `ldexp`, which take several times as long: the exponent of a
    # float is in its bits, and a power of two is built from it.
    exponent = (largest.view(np.int32) >> 23) - 126
    exponent = np.clip(np.where(largest == 0.0, 0, exponent), SMALLEST_EXPONENT, 127)
    power = ((8 - exponent + 127) << 23).astype(np.int32).view(np.float32)
    coded = np.empty((4, *largest.shape), np.uint8)
    for plane, channel in zip(coded[:3], light, strict=True):
        scaled = channel * power
        plane[...] = np.minimum(np.rint(scaled, out=scaled), 255.0, out=scaled)
    coded[3] = exponent + 128
    return coded


def _write(folder: Path, kind: str, planes: Bytes) -> str:
    """Write planes under a name derived from their content, once however often it is called."""
    name = hashlib.sha256(repr((kind, planes.shape)).encode() + planes.tobytes()).hexdigest()[:24]
    path = path_of(folder, name)
    if not path.exists():
        steps = planes.copy()
        steps[..., 1:] -= planes[..., :-1]
        packed = base64.b64encode(isal_zlib.compress(steps.tobytes(), LEVEL))
        height, width = planes.shape[1:]
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.write(f'picture("{name}",{width},{height},"{kind}","'.encode())
            file.write(packed)
            file.write(b'")\n')
    return name
