"""Jobs on the cores of this machine, in processes that save what they are at when they are stopped."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

T = TypeVar("T")
PATIENCE = 10.0  # s that workers have to save what they are at when they are stopped
ENDS = (KeyboardInterrupt, BrokenProcessPool)  # what ends a study early, which goes on by the same command


def why(end: BaseException) -> str:
    """What one of ENDS was, at the beginning of a sentence."""
    return "stopped" if isinstance(end, KeyboardInterrupt) else "a worker was lost (out of memory?)"


@contextlib.contextmanager
def kill_is_ctrl_c() -> Iterator[None]:
    """Let SIGTERM, too, be a KeyboardInterrupt, which ends the workers as well."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def cores(processes: int) -> int:
    """Processes that are asked for by a number of them, where 0 is as many as there are cores.

    Raises:
        ValueError: it is negative.
    """
    if processes < 0:
        raise ValueError(
            f"processes must be at least 1, or 0 for as many as there are cores, got {processes}"
        )
    return processes or os.cpu_count() or 1


def on_processes(work: Callable[[Any], Any], todo: Sequence[Any], processes: int) -> Generator[Any]:
    """What comes of the jobs, as it comes, from a pool of processes."""
    with pool_of(processes) as pool:
        waiting = {pool.submit(stop_at_once, work, job) for job in todo}
        try:
            while waiting:
                ended, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                yield from results(ended)
        except BaseException:
            stop(pool)
            raise


def results(ended: Iterable[Future[T]]) -> Iterator[T]:
    """Of jobs that ended; those that were done come first, so that a lost worker takes nothing along."""
    return (future.result() for future in sorted(ended, key=lambda each: each.exception() is not None))


def pool_of(processes: int) -> ProcessPoolExecutor:
    """Workers that their parent alone stops: Ctrl-C reaches them too, and would come twice."""
    context = multiprocessing.get_context("spawn")
    ignore = signal.SIGINT, signal.SIG_IGN
    return ProcessPoolExecutor(processes, context, initializer=signal.signal, initargs=ignore)


def stop_at_once(work: Callable[..., Any], *job: Any) -> Any:
    """One job, in a worker, to which `stop` is a KeyboardInterrupt; it begins no other one then."""

    def hear(*_: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # what is saved now is not to be interrupted
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGTERM) is signal.SIG_IGN:
        raise KeyboardInterrupt
    signal.signal(signal.SIGTERM, hear)
    try:
        return work(*job)
    finally:
        if signal.getsignal(signal.SIGTERM) is hear:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def stop(pool: ProcessPoolExecutor) -> None:
    """End all workers, which have some seconds to save what they are at."""
    workers = multiprocessing.active_children()
    pool.shutdown(wait=False, cancel_futures=True)
    until = time.monotonic() + PATIENCE
    try:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join(max(0.0, until - time.monotonic()))
    finally:
        for worker in workers:
            worker.kill()
