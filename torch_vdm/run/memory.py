"""What the C library keeps of the memory that a call frees."""

import ctypes
import os
import sys
from functools import cache

import torch

# The largest block that glibc learns from, 32 MiB, but for what it adds itself; in bytes. It then
# keeps twice as much. Source: mallopt(3), M_MMAP_THRESHOLD.
LARGEST_LEARNED = 2**25 - 2**16

# What Dask starts its workers with, which ends that learning: all freed memory over so many bytes
# goes back, and a call takes three times as long. Source: Dask's documentation, "Worker Memory
# Management". And glibc's numbers of its two options. Source: malloc.h.
TRIM, DASKS_TRIM = "MALLOC_TRIM_THRESHOLD_", "65536"
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3


@cache
def keep_freed_memory() -> None:
    """Let the C library keep what is freed, once in a process.

    Glibc gives freed memory back to the system above twice the largest block that it has seen
    freed. Of images of 0.1 to 1 megapixels all of a call's memory is above that, and the next call
    gets it anew, page by page. The block here is never written to, so it takes no memory itself;
    other C libraries do not mind it. What a user has set is left, what Dask has set is not.
    """
    torch.empty(LARGEST_LEARNED, dtype=torch.uint8, device="cpu")
    if sys.platform == "linux" and os.environ.get(TRIM) == DASKS_TRIM:
        library = ctypes.CDLL(None)
        if hasattr(library, "mallopt"):
            library.mallopt(M_MMAP_THRESHOLD, LARGEST_LEARNED)
            library.mallopt(M_TRIM_THRESHOLD, 2 * LARGEST_LEARNED)
