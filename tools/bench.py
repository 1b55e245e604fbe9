"""How fast it is: `python tools/bench.py NAME [--json FILE]`, NAME among those that `--help` lists.

Ratios are taken between two ways of doing the same work that take turns within one run, so that they mean
something on a busy machine too; rates a second do only on an idle one. Where our work is compared with the
bare engine's (`engine`, and in `planner` the efficiencies and `mppi_overhead`), both must have come to the
same states.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from rich.console import Console

from hmc.cli import command_line, one_line_errors
from tools.benchmarks.deployed import Deployed, deployed
from tools.benchmarks.engine import Engine, engine
from tools.benchmarks.estimator import Estimator, estimator
from tools.benchmarks.figures import NOT_MEASURED, Figures, cores, machine
from tools.benchmarks.gpu import Gpu, gpu
from tools.benchmarks.growth import Growth, growth
from tools.benchmarks.planner import Planner, planner
from tools.benchmarks.train import Train, train
from tools.benchmarks.wire import Wire, wire
from tools.study import at_one_go, can_write, write_json


@at_one_go
def main(args: Engine | Train | Planner | Wire | Estimator | Deployed | Growth | Gpu) -> int:
    """Measure, print, write."""
    threads = args.threads or cores()
    args = replace(args, threads=threads)
    # searches run on one torch thread, see `plan`
    torch.set_num_threads(1 if isinstance(args, Engine | Planner | Deployed) else threads)
    torch.manual_seed(0)
    name = type(args).__name__.lower()
    host = machine(threads)
    with one_line_errors():
        if args.json is not None:
            can_write(args.json)
        figures = measure(args)
    console = Console()
    console.print(figures.table(f"bench {name}"))
    for key, note in figures.notes.items():
        if key not in figures.values:
            console.print(note)
    console.print(", ".join(f"{key} {value}" for key, value in host.items()), highlight=False)
    if args.json is not None:
        missing = dict.fromkeys(figures.missing, NOT_MEASURED)
        write_json(args.json, {"bench": name, **figures.values, **missing, "machine": host})
    return 0


def measure(args: Engine | Train | Planner | Wire | Estimator | Deployed | Growth | Gpu) -> Figures:
    """The figures of one of them."""
    match args:
        case Engine():
            return engine(args)
        case Train():
            return train(args)
        case Planner():
            return planner(args)
        case Wire():
            return wire(args)
        case Estimator():
            return estimator(args)
        case Deployed():
            return deployed(args)
        case Growth():
            return growth(args)
        case Gpu():
            return gpu(args)


if __name__ == "__main__":
    sys.exit(main(command_line(Engine | Train | Planner | Wire | Estimator | Deployed | Growth | Gpu)))
