"""How much of the memory that a call frees the C library keeps."""

import ctypes
import os
import sys
from functools import cache

# Freed memory that glibc keeps in a process, in bytes, once it was used: enough for a map at
# 1920 x 1080 with any transform, and for its gradient with `Haar`. Status: choice, measured.
KEPT = 2**29

# The largest block that it serves from there, in bytes: a plane of four channels at 4K. Before
# version 2.35 glibc accepts no more than the second. Source: mallopt(3). Status: choice.
LARGEST_BLOCKS = 2**27, 2**25

# Its numbers for the two options. Source: malloc.h.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3

# How a user sets them otherwise; and what Dask sets in its workers, which is no user's choice.
# Source: mallopt(3), and Dask's "Worker Memory Management".
BY_USERS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "MALLOC_TOP_PAD_")
TUNABLES = "GLIBC_TUNABLES"
BY_DASK = {"MALLOC_TRIM_THRESHOLD_": "65536"}


@cache
def keep_freed_memory() -> None:
    """Let the C library keep freed memory, once per process.

    By default glibc returns nearly all freed memory to the system, and the next call gets it anew,
    page by page: a quarter of the time of a map at 1920 x 1080. Nothing is done if a user has set
    what it keeps, nor with other C libraries.
    """
    if sys.platform != "linux" or _is_set():
        return
    library = ctypes.CDLL(None)
    if not hasattr(library, "mallopt"):
        return
    # The first also stops glibc from choosing both by itself; without it the second would do harm.
    if any(library.mallopt(M_MMAP_THRESHOLD, size) for size in LARGEST_BLOCKS):
        library.mallopt(M_TRIM_THRESHOLD, KEPT)


def _is_set() -> bool:
    by_user = [n for n in BY_USERS if n in os.environ and os.environ[n] != BY_DASK.get(n)]
    return bool(by_user) or "glibc.malloc" in os.environ.get(TUNABLES, "")
