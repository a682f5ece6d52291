"""What the C library keeps of the memory that a call frees."""

from functools import cache

import torch

# The largest block that glibc learns from, 32 MiB, but for what it adds itself; in bytes. It then
# keeps twice as much. Source: mallopt(3), M_MMAP_THRESHOLD.
LARGEST_LEARNED = 2**25 - 2**16


@cache
def keep_freed_memory() -> None:
    """Let the C library keep what is freed, once in a process.

    Glibc gives freed memory back to the system above twice the largest block that it has seen
    freed. Of images of 0.1 to 1 megapixels all of a call's memory is above that, and the next call
    gets it anew, page by page. The block here is never written to, so it takes no memory itself;
    other C libraries do not mind it.
    """
    torch.empty(LARGEST_LEARNED, dtype=torch.uint8, device="cpu")
