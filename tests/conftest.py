"""Where test data lives, what images tests are made of, and the reference's observer."""

import dataclasses
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import settings
from numpy.typing import NDArray

from benchmarks import places
from sampling.renderers.llvm import LLVMError
from sampling.renderers.mitsuba import SceneError, load_mitsuba
from tests.reference import calibrated
from torch_vdm import Haar, Observer
from torch_vdm.model.cortex import Transform

settings.register_profile("default", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("default")

# A shell lets what it starts in the background ignore Ctrl-C, and so would the commands under test.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The images of tests are small: threads would wait for each other longer than they compute.
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of shared data; a test that needs it is skipped where it is missing."""
    folder = places.shared_data()
    if not folder.is_dir():
        pytest.skip(f"no shared data at {folder}: set TORCH_VDM_DATA to its folder")
    return folder


@pytest.fixture(scope="session")
def mitsuba() -> Any:
    """Return Mitsuba; a test that needs it is skipped where it cannot run."""
    try:
        return load_mitsuba("llvm_ad_rgb")
    except (SceneError, LLVMError) as error:
        pytest.skip(str(error))


KINDS = ("random", "flat", "black", "hdr", "dark", "negative")


def one_line_error(
    main: Callable[[Sequence[str]], int], capsys: pytest.CaptureFixture[str], *arguments: str
) -> str:
    """Return the one line on standard error of a command that ends with 2."""
    try:
        status = main(arguments)
    except SystemExit as ending:
        status = int(ending.code or 0)
    told = capsys.readouterr()
    assert status == 2
    assert told.out == ""
    assert told.err.count("\n") == 1
    return told.err


def make_xyz(kind: str, height: int, width: int, seed: int) -> NDArray[np.float64]:
    """Return an image (3, H, W) of absolute XYZ in cd/m2."""
    rng = np.random.default_rng(seed)
    shape = (3, height, width)
    match kind:
        case "random":
            return rng.uniform(1.0, 100.0, shape)
        case "flat":
            return np.broadcast_to(rng.uniform(1.0, 100.0, (3, 1, 1)), shape).copy()
        case "black":
            return np.zeros(shape)
        case "hdr":
            return np.exp(rng.normal(2.0, 3.0, shape))
        case "dark":
            return rng.uniform(0.0, 1e-3, shape)
        case "negative":
            return rng.uniform(-0.5, 20.0, shape)
        case _:
            raise ValueError(kind)


def reference_numbers(transform: Transform | None = None) -> calibrated.CalibratedParameters:
    """Return the calibrated observer's numbers, fitted to a transform, as the reference takes them.

    To `Haar` by default.
    """
    names = {field.name for field in dataclasses.fields(calibrated.CalibratedParameters)}
    observer = Observer.calibrated().fitted_to(transform or Haar())
    return calibrated.CalibratedParameters(
        **{name: value for name, value in vars(observer).items() if name in names}
    )
