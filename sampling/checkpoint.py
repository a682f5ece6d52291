"""A run on disk: written whole or not at all, continued bit for bit, or refused with a reason."""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torch_vdm.io.refusal import printable

# The format's name in a file, and its version, which is raised when the layout changes.
FORMAT = "vdm-render checkpoint"
FORMAT_VERSION = 1

# The entry of the archive that holds everything but arrays, as JSON, and the prefix of the names
# of arrays.
_HEADER, _ARRAY = "header", "array."

# What identifies a run, and its name in messages where two runs differ.
WORDS = {
    "version": "version of torch-vdm",
    "mitsuba": "version of Mitsuba",
    "variant": "variant",
    "size": "image size",
    "seed": "--seed",
    "strategy": "--strategy",
    "tolerance": "--tolerance",
    "max_spp": "--max-spp",
    "noise_threshold": "--noise-threshold",
    "unbiased": "--unbiased",
    "ppd": "--ppd",
    "white": "--white",
    "observer": "--observer",
    "observer_numbers": "the observer's numbers",
    "aov": "--aov",
    "filter": "--filter",
    "sensor": "--sensor",
}


class CheckpointError(ValueError):
    """A checkpoint that cannot be read, written or continued; the message is one line."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class Checkpoint(NamedTuple):
    """What is saved of a run."""

    identity: dict[str, Any]
    """What identifies the run: the scene's hash under "scene", and every key of `WORDS`."""
    state: dict[str, Any]
    """Arrays, numbers, strings, booleans and None, by name."""


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint; an existing one is replaced once the new one is complete.

    It is an uncompressed NumPy archive (npz) without pickled objects: arrays, and one string of
    JSON for everything else.

    Raises
    ------
    CheckpointError
        If it cannot be written.
    """
    arrays = {name: v for name, v in checkpoint.state.items() if isinstance(v, np.ndarray)}
    header = {
        FORMAT: FORMAT_VERSION,
        "identity": checkpoint.identity,
        "arrays": sorted(arrays),
        "values": {name: v for name, v in checkpoint.state.items() if name not in arrays},
    }
    # An existing file there is never written to: it may be a link to something else.
    temporary = partial_of(path)
    try:
        temporary.unlink(missing_ok=True)
        with temporary.open("xb") as file:
            entries: dict[str, Any] = {_ARRAY + name: array for name, array in arrays.items()}
            entries[_HEADER] = np.array(json.dumps(header))
            np.savez(file, **entries)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise CheckpointError(f"{path}: cannot be written: {error.strerror or error}") from error


def partial_of(path: Path) -> Path:
    """Return the file that a checkpoint is while it is written.

    Always the same name: a process killed while writing leaves one file, not many.
    """
    return path.with_name(f".{path.name}.partial")


def load(path: Path, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of a checkpoint that belongs to the run described by ``identity``.

    Raises
    ------
    CheckpointError
        If the file is missing, damaged or not a checkpoint, or the run was begun with another
        scene, version or settings.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            header: dict[str, Any] = json.loads(str(archive[_HEADER]))
            version = header[FORMAT]
            if version == FORMAT_VERSION:
                arrays = {name: archive[_ARRAY + name] for name in header["arrays"]}
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: no such file; check the name") from error
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # NumPy and zipfile raise whatever a damaged byte leads to
        raise CheckpointError(
            f"{path}: expected a checkpoint of vdm-render, got a damaged or another file; "
            "start anew without --resume"
        ) from error
    if version != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: expected a checkpoint of format {FORMAT_VERSION}, got "
            f"{version}; continue it with the version that wrote it"
        )
    begun = header["identity"]
    for name, words in WORDS.items():
        if begun.get(name) != identity.get(name):
            raise CheckpointError(
                f"{path}: begun with {words} {begun.get(name)}, and this is {identity.get(name)}; "
                "give the same, or start anew without --resume"
            )
    if begun.get("scene") != identity.get("scene"):
        raise CheckpointError(
            f"{path}: begun with another scene: the file, a file that it names or a -D has changed "
            "since; start anew without --resume"
        )
    values: dict[str, Any] = header["values"]
    return arrays | values
