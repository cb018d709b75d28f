"""How many threads compute a constant: one."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch in the block, or in the function that it decorates: the same bits in every process.

    Eigenvectors depend on the number of threads, and of two threads that share an `exp` on a busy machine one may work
    at lower accuracy than the other, off by some 1e-10.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
