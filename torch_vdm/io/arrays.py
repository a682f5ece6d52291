"""NumPy's .npy files, read part by part: how an image larger than memory lies on a disk."""

import os
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.refusal import ImageError, require_finite, without_negatives

MAGIC = b"\x93NUMPY"

# What is taken: whole numbers from 0 to white, and light.
CODED, LINEAR = ("uint8", "uint16"), ("float16", "float32", "float64")


class ArrayFile:
    """An image in a .npy file, (3, H, W) or (H, W, 3); indexed, it gives parts of (3, H, W).

    The file is mapped anew for each part, so that what was read leaves memory with it.

    Parameters
    ----------
    path
        The file, of uint8 or uint16 (sRGB-coded, 0 to white) or float16, 32 or 64 (linear).
    nonfinite, negative
        As in `torch_vdm.io.load`, for the parts that are read.

    Raises
    ------
    ImageError
        If the file is missing, damaged or of another shape or type; on reading, if values are
        refused. The message is one line that names the file.
    """

    def __init__(
        self, path: str | os.PathLike[str], nonfinite: str = "raise", negative: str = "keep"
    ) -> None:
        self.path = Path(path)
        self.nonfinite, self.negative = nonfinite, negative
        array = self._array()
        self.shape = tuple(int(side) for side in array.shape)
        self.linear = array.dtype.name in LINEAR
        if array.dtype.name not in CODED + LINEAR:
            self._refuse(f"expected numbers of {', '.join(CODED + LINEAR)}, got {array.dtype}")
        if len(self.shape) != 3 or self.shape[0] != 3 or 0 in self.shape:
            self._refuse(f"expected a shape (3, H, W) or (H, W, 3), got {array.shape}")

    def __getitem__(self, index: Any, /) -> NDArray[Any]:
        """Return a part, of slices for channels, rows and columns, as an array in memory."""
        part = np.array(self._array()[index])
        if not self.linear:
            return part
        said: list[str] = []  # not used: a part is read more than once, see `notes`
        rows, columns = index[-2:]
        origin = columns.start or 0, rows.start or 0
        try:
            part = require_finite(part, self.nonfinite, said, origin)
            return without_negatives(part, self.negative, said, origin)
        except ImageError as error:
            raise ImageError(f"{self.path}: {error}") from None

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed, one sentence each."""
        told = [f"{'Linear' if self.linear else 'sRGB-coded'} for its type; read part by part."]
        if self.linear and self.nonfinite == "zero":
            told.append("0 is put in the place of NaN and infinity.")
        if self.linear and self.negative == "clip":
            told.append("0 is put in the place of negative values.")
        return tuple(told)

    def _array(self) -> NDArray[Any]:
        try:
            array: NDArray[Any] = np.load(self.path, mmap_mode="r")
        except (OSError, ValueError, EOFError) as error:
            self._refuse(f"damaged or no array: {' '.join(str(error).split())}; write it again")
        if array.ndim == 3 and array.shape[0] != 3 and array.shape[2] == 3:
            array = array.transpose(2, 0, 1)
        return array

    def _refuse(self, what: str) -> NoReturn:
        raise ImageError(f"{self.path}: {what}")
