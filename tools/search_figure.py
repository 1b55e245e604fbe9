"""Draw the search of the example in docs/planner.md: `python tools/search_figure.py`."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import matplotlib.pyplot as plt  # noqa: E402
from matplotlib.patches import Rectangle  # noqa: E402

from hmc import Plan  # noqa: E402
from hmc.cli import command_line  # noqa: E402
from tools.figures import save  # noqa: E402

COLORS = ("#7aa6c2", "#d1495b")


@dataclass(frozen=True)
class Args:
    """Command line.

    Attributes:
        out: picture to write.
    """

    out: Path = ROOT / "docs" / "planner.png"


def example() -> dict[str, Any]:
    """Names that the example of docs/planner.md leaves behind when it is run."""
    text = (ROOT / "docs" / "planner.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {"__name__": "example"}
    exec(re.findall(r"```python\n(.*?)```", text, re.S)[0], names)
    return names


def draw(plan: Plan, path: Path) -> None:
    """The incumbent and the schedule after each accepted switch, one below the other, with their costs."""
    schedules = [plan.incumbent]
    for switch in plan.switches:
        schedules.append(schedules[-1].stitch(switch))
    figure, axis = plt.subplots(figsize=(9, 0.45 * len(schedules) + 1.2), constrained_layout=True)
    for row, (schedule, cost) in enumerate(zip(schedules, plan.costs, strict=True)):
        for run in schedule.runs():
            axis.barh(row, run.duration, left=run.start, color=COLORS[run.mode], height=0.7)
        if row > 0:
            switch = plan.switches[row - 1]
            box = (switch.start, row - 0.35), switch.duration, 0.7
            axis.add_patch(Rectangle(*box, fill=False, linewidth=1.8, edgecolor="black"))
        axis.text(len(schedule) + 2, row, f"{cost:.5g}", va="center", fontsize=9)
    axis.set_yticks(range(len(schedules)), ["incumbent", *map(str, range(1, len(schedules)))])
    axis.set_xlim(0, len(plan.schedule) * 1.08)
    axis.set_ylim(len(schedules) - 0.4, -0.6)
    axis.set_xlabel("control step; at the right: cost")
    axis.set_ylabel("accepted switches")
    names = plan.schedule.names or ()
    handles = [Rectangle((0, 0), 1, 1, color=color) for color in COLORS]
    axis.legend(handles, names, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    save(figure, path)


if __name__ == "__main__":
    args = command_line(Args)
    draw(example()["plan"], args.out)
    print(args.out)
