"""What a call leaves to the next one, in a process that has done nothing else."""

import os
import platform
import subprocess
import sys

import pytest

# Pages that the system gives a call whose memory was kept from the call before, of about 3000 that
# it works on; without `keep_freed_memory` it gives most of them, at this size.
CALL = """
import resource, torch
from torch_vdm import VDM
torch.set_num_threads(1)
metric = VDM()
test, reference = torch.rand(2, 1, 3, 512, 512)
def pages():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    metric(test, reference)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
with torch.no_grad():
    print(min([pages() for _ in range(5)][2:]))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="memory is kept by glibc")
@pytest.mark.parametrize("set_before", [{}, {"MALLOC_TRIM_THRESHOLD_": "65536"}])
def test_freed_memory_is_kept_for_the_next_call(set_before: dict[str, str]) -> None:
    """By itself, and in a worker of Dask, which has it given back."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    done = subprocess.run(
        [sys.executable, "-c", CALL],
        capture_output=True,
        text=True,
        check=True,
        env=own | set_before,
    )
    assert int(done.stdout) < 300
