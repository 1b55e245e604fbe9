"""Keeps the control process's core from halting between two state frames: it would wake up late, and cold.

It has the lowest priority there is, which still gets a slice of 4 ms now and then beside a normal one: it is
for a control process with real-time priority, which takes the core at once.
"""

from __future__ import annotations

import ctypes
import os
import signal

from deploy.process import Job, told, until_told


def spin() -> None:
    """Wait for a lock that nobody gives back: a loop that leaves a hyperthread beside it most of the core."""
    library, lock = ctypes.CDLL(None), ctypes.c_int()
    library.pthread_spin_init(ctypes.byref(lock), 0)
    while True:
        library.pthread_spin_lock(ctypes.byref(lock))


def main(job: Job) -> None:
    """Be awake until SIGTERM."""
    stopped = until_told(job.parent)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what waits for a lock hears of no handler
    assert job.core is not None
    os.sched_setaffinity(0, {job.core})
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    if not stopped():
        spin()


if __name__ == "__main__":
    main(told())
