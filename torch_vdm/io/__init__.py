"""Images read from files and written to files; docs/files.md lists the formats."""

from torch_vdm.io.arrays import ArrayFile
from torch_vdm.io.files import (
    Image,
    atomic_path,
    check_target,
    load,
    read_image,
    remove_abandoned,
    write_channels,
    write_image,
)
from torch_vdm.io.refusal import ImageError

__all__ = [
    "ArrayFile",
    "Image",
    "ImageError",
    "atomic_path",
    "check_target",
    "load",
    "read_image",
    "remove_abandoned",
    "write_channels",
    "write_image",
]
