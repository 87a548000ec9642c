"""Work that lets go of Python's lock, on as many plain threads as torch is set to."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

import torch


def side_by_side(work: Callable[[int], None], count: int) -> None:
    """``work(0)`` to ``work(count - 1)`` on as many threads as torch is set to, the caller's among them."""
    threads, numbers = min(torch.get_num_threads(), count), iter(range(count))

    def share() -> None:
        for number in numbers:  # Python's lock hands every number to one thread
            work(number)

    others = [_pool(threads - 1).submit(share) for _ in range(threads - 1)]
    try:
        share()
    finally:
        list(numbers)  # after a failure nothing new is begun
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


def library_threads() -> int:
    """On how many threads a library may work that has OpenMP start them: as many as torch is set to.

    One in a forked process, a worker of a data loader, say: OpenMP waits there for its parent's threads for ever.
    """
    return 1 if _FORKED else torch.get_num_threads()


_POOLS: dict[int, ThreadPoolExecutor] = {}
_FORKED: list[bool] = []


def _pool(threads: int) -> ThreadPoolExecutor:
    return _POOLS.setdefault(threads, ThreadPoolExecutor(threads, thread_name_prefix="bbr_layer"))


def _forked() -> None:
    """A forked process has none of its parent's threads."""
    _POOLS.clear()
    _FORKED.append(True)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)
