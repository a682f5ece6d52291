"""NumPy's .npy files, read part by part: for images larger than memory."""

import os
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from torch_vdm.io.refusal import ImageError, Negative, Nonfinite, require_finite, without_negatives

MAGIC = b"\x93NUMPY"

# The types read: whole numbers from 0 to white, and floats of light or, if asked for, of code.
WHOLE, FLOATS = ("uint8", "uint16"), ("float16", "float32", "float64")


class ArrayFile:
    """An image in a .npy file, (3, H, W) or (H, W, 3); indexing returns parts of (3, H, W).

    The file is mapped anew for each part, so that the pages read leave memory with it.

    Parameters
    ----------
    path
        The file, of uint8 or uint16 (sRGB-coded, 0 to white) or float16, 32 or 64 (linear).
    nonfinite, negative, coded
        As in `torch_vdm.io.load`, for the parts that are read.

    Raises
    ------
    ImageError
        If the file is missing, damaged or of another shape or type; on reading, if values are
        refused. The message is one line that names the file.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        nonfinite: Nonfinite = "raise",
        negative: Negative = "keep",
        coded: bool = False,
    ) -> None:
        self.path = Path(path)
        self.nonfinite, self.negative = nonfinite, negative
        array = self._array()
        self.shape = tuple(int(side) for side in array.shape)
        self.floating = array.dtype.name in FLOATS
        self.linear = self.floating and not coded
        if array.dtype.name not in WHOLE + FLOATS:
            self._refuse(
                f"expected numbers of {', '.join(WHOLE + FLOATS)}, got {array.dtype}; scale them "
                "to one of these"
            )
        if len(self.shape) != 3 or self.shape[0] != 3 or 0 in self.shape:
            self._refuse(f"expected a shape (3, H, W) or (H, W, 3), got {array.shape}")

    def __getitem__(self, index: Any, /) -> NDArray[Any]:
        """Return the part at slices of channels, rows and columns, as an array in memory."""
        stored = self._array()
        native = stored.dtype.newbyteorder("=")
        if not self.floating:
            whole: NDArray[Any] = stored[index].astype(native)
            return whole
        # With neighbours around the part, where NaN is to become their mean.
        margin = 1 if self.nonfinite == "clamp" else 0
        begins = [max(0, (side.start or 0) - margin) for side in index[1:]]
        wide = [
            slice(begin, None if side.stop is None else side.stop + margin)
            for begin, side in zip(begins, index[1:], strict=True)
        ]
        said: list[str] = []  # not used: a part is read more than once, see `notes`
        origin = begins[1], begins[0]
        try:
            part = stored[(index[0], *wide)].astype(native)
            part = require_finite(part, self.nonfinite, said, origin)
            part = without_negatives(part, self.negative, said, origin)
        except ImageError as error:
            raise ImageError(f"{self.path}: {error}") from None
        inner = [
            slice((side.start or 0) - begin, None if side.stop is None else side.stop - begin)
            for begin, side in zip(begins, index[1:], strict=True)
        ]
        return part[(slice(None), *inner)]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was assumed, one sentence each."""
        why = "as asked for (--coded)" if self.floating and not self.linear else "for its type"
        told = [f"{'Linear' if self.linear else 'sRGB-coded'} {why}; read part by part."]
        if self.floating and self.nonfinite == "zero":
            told.append("0 is put in the place of NaN and infinity.")
        if self.floating and self.nonfinite == "clamp":
            told.append(
                "Infinity is held to the type's largest value, NaN to its neighbours' mean."
            )
        if self.floating and self.negative == "clip":
            told.append("0 is put in the place of negative values.")
        return tuple(told)

    def _array(self) -> NDArray[Any]:
        try:
            array: NDArray[Any] = np.load(self.path, mmap_mode="r")
        except Exception as error:
            # NumPy parses the header as Python, and raises whatever that raises on a damaged one.
            told = " ".join(str(error).split())[:200]
            self._refuse(f"damaged or no array: {told}; write it again")
        if array.ndim == 3 and array.shape[0] != 3 and array.shape[2] == 3:
            array = array.transpose(2, 0, 1)
        return array

    def _refuse(self, what: str) -> NoReturn:
        raise ImageError(f"{self.path}: {what}")
