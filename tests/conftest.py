"""Set-up of the test run: one thread a library, no display, repeatable examples."""

import os
import signal

# Before torch, numpy or MuJoCo load: their pools would fight over the cores with the sim's own threads.
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
import torch
from _pytest.runner import runtestprotocol
from hypothesis import settings

from deploy.timing import Stolen

TRIES = 4

torch.set_num_threads(1)
settings.register_profile("hmc", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("hmc")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell's background job, whose children inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """Every test starts from the same global torch seed, whatever ran before it."""
    torch.manual_seed(0)


@pytest.fixture
def cuda() -> torch.device:
    """The GPU; the test is skipped where there is none."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return torch.device("cuda")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """A test of the clock that fails while its host takes a virtual machine's cores away says nothing.

    It is run anew, with fixtures of its own, up to three times. Where no time was stolen, a failure is one.
    """
    if item.get_closest_marker("clock") is None:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for tries in range(1, TRIES + 1):
        stolen = Stolen()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if tries == TRIES or not stolen.share or not any(report.failed for report in reports):
            break
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
