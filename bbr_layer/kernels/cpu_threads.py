"""Work that lets go of Python's lock, on as many plain threads as torch is set to."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch


def side_by_side(work: Callable[[int], None], count: int) -> None:
    """``work(0)`` to ``work(count - 1)`` on as many threads as torch is set to."""
    threads = min(torch.get_num_threads(), count)
    if threads == 1:
        for number in range(count):
            work(number)
    else:
        for done in _pool(threads).map(work, range(count)):
            assert done is None


_POOLS: dict[int, ThreadPoolExecutor] = {}


def _pool(threads: int) -> ThreadPoolExecutor:
    return _POOLS.setdefault(threads, ThreadPoolExecutor(threads, thread_name_prefix="bbr_layer"))


# A forked process (a worker of a data loader) has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_POOLS.clear)
