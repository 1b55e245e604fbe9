"""Jobs of a study on a Ray cluster: many machines, or this one; what a lost worker left is done again."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RETRIES = (
    10  # of a job whose worker or machine was lost; one that takes its worker along each time ends there
)


def join(address: str, cores: int) -> None:
    """Become part of a Ray cluster.

    Args:
        address: of its head, such as 10.0.0.1:6379; empty for the cluster that this machine is part of, or
            where it is part of none, for one of this machine alone that ends with this process.
        cores: of this machine that a cluster of its own takes.

    Raises:
        ValueError: Ray is not installed, no cluster answers or starts, or it is of another version.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise ValueError(
            "--ray needs the package ray: pip install 'hmc[ray]', or leave --ray out: processes of this "
            "machine do the work then"
        ) from None
    # the workers of a cluster of this machine alone find our packages from whatever folder they start in
    paths = [str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    os.environ["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a study tells nobody
    quiet: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    address = address or os.environ.get("RAY_ADDRESS", "auto")
    try:
        if address != "auto":
            _reach(address)
            ray.init(address, **quiet)
        elif here := _current():
            ray.init(here, **quiet)
        else:
            _start(cores, **quiet)
    except Exception as error:  # of any kind: Ray raises the bare one, too
        raise ValueError(
            f"no Ray cluster to work on at {address} ({error}): start its head with 'ray start --head' and "
            "name it as HOST:PORT, or leave --ray out: processes of this machine do the work then"
        ) from error


def _reach(address: str) -> None:
    """Raise an error unless something answers at an address: Ray would try for minutes, or for ever."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    socket.create_connection((host, int(port)), timeout=10).close()


def _current() -> str:
    """The cluster that this machine is part of; empty if there is none, or none any more."""
    from ray._private.services import get_ray_address_from_environment

    try:
        address = str(get_ray_address_from_environment("auto", None))
        _reach(address)  # one that was killed has left its address
    except OSError:
        return ""
    return address


def _start(cores: int, attempts: int = 3, **quiet: Any) -> None:
    """Start a cluster of this machine; Ray gives up after half a minute, which a busy one may need twice."""
    import ray

    for attempt in range(attempts):
        try:
            ray.init("local", num_cpus=cores, include_dashboard=False, **quiet)
            return
        except Exception:
            ray.shutdown()
            if attempt == attempts - 1:
                raise


def on_ray(work: Callable[[Any], Any], todo: Sequence[Any]) -> Generator[Any]:
    """What comes of the jobs, each once, as it comes, from the cluster that was joined; it is left after."""
    import ray

    # one core a job; a job whose worker is lost goes to another one
    task = ray.remote(num_cpus=1, max_retries=RETRIES)(work_on)
    shared = ray.put(work)
    waiting = [task.remote(shared, job) for job in todo]
    try:
        while waiting:
            (ended, *_), waiting = ray.wait(waiting)
            yield ray.get(ended)
    finally:
        ray.shutdown()


def work_on(work: Callable[[Any], Any], job: Any) -> Any:
    """One job, in a worker."""
    return work(job)
