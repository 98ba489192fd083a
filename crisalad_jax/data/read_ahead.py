"""Compute items ahead of their use, in a fixed order, by threads or processes."""

import collections
import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

import cv2

from crisalad_jax.utils.errors import InputError

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def read_ahead(
    work: Callable[[_Item], _Result],
    items: Sequence[_Item],
    *,
    ahead: int,
    threads: int,
    num_workers: int = 0,
) -> Generator[_Result, None, None]:
    """Yield the result of `work` for each item, in the order of the items.

    Closing the generator cancels the work that has not begun.

    Args:
        work: for processes it must be picklable.
        items: what to work on.
        ahead: number of items that are worked on before they are asked for.
        threads: number of threads; 0 works in the caller's.
        num_workers: number of processes to use instead, which take seconds to start. Each imports
            the main program, which needs `if __name__ == "__main__"`.

    Raises:
        InputError: a process has ended.
    """
    if not threads and not num_workers:
        yield from map(work, items)
        return
    executor: Executor
    if num_workers:
        # Spawn, not fork: a fork of a process that uses JAX can deadlock.
        context = multiprocessing.get_context("spawn")
        executor = ProcessPoolExecutor(num_workers, context, _begin_work, (work,))
        task: Callable[[Any], Any] = _do_work
    else:
        executor, task = ThreadPoolExecutor(threads), work
    waiting: collections.deque[Future[_Result]] = collections.deque()
    rest = iter(items)
    try:
        waiting.extend(executor.submit(task, item) for item in itertools.islice(rest, ahead))
        while waiting:
            result = waiting.popleft().result()
            waiting.extend(executor.submit(task, item) for item in itertools.islice(rest, 1))
            yield result
    except BrokenProcessPool as error:
        raise InputError(
            f"num_workers: one of {num_workers} that read images has ended: {error}"
        ) from error
    finally:
        executor.shutdown(cancel_futures=True)


def one_ahead(stream: Generator[_Item, None, None]) -> Generator[_Item, None, None]:
    """Yield a stream's items, each computed in a thread while the item before it is in use."""
    with contextlib.closing(stream), ThreadPoolExecutor(1) as thread:
        ahead = thread.submit(next, stream, None)
        while (item := ahead.result()) is not None:
            ahead = thread.submit(next, stream, None)
            yield item


_work: Callable[[Any], Any]
"""Function that a worker process applies to each item."""


def _begin_work(work: Callable[[Any], Any]) -> None:
    """Set up a worker process: it ignores signals, and ends when its parent does."""
    global _work
    _work = work
    cv2.setNumThreads(1)
    # A terminal or a scheduler signals every process.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_it() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_it, daemon=True).start()


def _do_work(item: Any) -> Any:
    return _work(item)
