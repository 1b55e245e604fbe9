"""Set-up of the test run: one thread a library, no display, repeatable examples."""

import os

# Before torch, numpy or MuJoCo load: their pools would fight over the cores with the sim's own threads.
for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("hmc", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("hmc")


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
