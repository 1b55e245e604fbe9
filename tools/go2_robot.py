"""A stand-in for the robot on the robot's own topics: `python tools/go2_robot.py --robot.start lying`."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))


from deploy.dds import LinkError
from hmc.cli import command_line
from tools.robot.process import Args, run


def main(args: Args) -> int:
    """Be the robot until told to end or without its parent; exit status 2 and one line on bad input."""
    told: list[int] = []

    def stopped() -> bool:
        return bool(told) or args.parent not in (0, os.getppid())

    def say(text: str) -> None:
        with suppress(BrokenPipeError):  # nobody listens any more
            print(text, flush=True)

    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda number, _: told.append(number))
    try:
        run(args, stopped, say)
    except (LinkError, ValueError, OSError) as error:
        return _said(error, 2)
    except RuntimeError as error:  # the simulated robot diverged
        return _said(error, 1)
    return 0


def _said(error: Exception, status: int) -> int:
    print(f"go2_robot: {' '.join(str(error).split())}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main(command_line(Args)))
