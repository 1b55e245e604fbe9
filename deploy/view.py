"""What a run looks like while it goes on: phase, mode, plan age, lateness, faults; in place on a terminal."""

from __future__ import annotations

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from deploy.modes import NAMES
from deploy.safety import Phase
from deploy.slots import said
from deploy.timing import EDGES

_COLORS = {Phase.PASSIVE: "dim", Phase.HYBRID: "green", Phase.DAMPING: "red"}


def picture(status: np.ndarray) -> RenderableType:
    """A value of the status slot as a table and a histogram of lateness."""
    phase, mode = Phase(int(status["phase"])), int(status["mode"])
    table = Table(show_header=False, box=None)
    color = _COLORS.get(phase, "yellow")
    reason = escape(said(status["reason"].item()))
    table.add_row("phase", f"[{color}]{phase.name.lower()}[/] {reason}")
    table.add_row("mode", NAMES[mode] if mode >= 0 and phase == Phase.HYBRID else "-")
    table.add_row("body", f"pitch {status['pitch']:+.0f} deg, height {status['height']:.2f} m")
    table.add_row("battery", f"{status['charge']} %")
    age = f"{20 * int(status['plan_age'])} ms" if status["plan_age"] >= 0 else "-"
    table.add_row("plan", f"age {age}, {status['plans']} taken over, {status['late_plans']} too late")
    table.add_row("ticks", f"{status['ticks']}, {status['missed']} missed")
    table.add_row("faults", said(status["faults"].item()) or "none")
    return Group(table, histogram(status["late"]))


def histogram(bins: np.ndarray) -> Text:
    """Ticks by lateness as bars."""
    most, text = max(int(bins.max()), 1), Text("late by\n")
    for i, count in enumerate(bins.tolist()):
        edge = f"< {EDGES[i]:g} ms" if i < len(EDGES) else "more"
        text.append(f"{edge:>9} {'#' * round(30 * count / most):<30} {count}\n")
    return text


class View:
    """Shows the status on a terminal in place, elsewhere a line at each change of phase or mode."""

    def __init__(self, console: Console):
        self._console = console
        self._live = Live(console=console, transient=True) if console.is_terminal else None
        self._last = (-1, -1, "")

    def __enter__(self) -> View:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, status: np.ndarray) -> None:
        """The newest status."""
        if self._live is not None:
            self._live.update(picture(status))
            return
        now = (int(status["phase"]), int(status["mode"]), said(status["reason"].item()))
        if now != self._last:
            self._last = now
            mode = NAMES[now[1]] if now[1] >= 0 and now[0] == Phase.HYBRID else ""
            words = (Phase(now[0]).name.lower(), mode, now[2])
            seconds = 0.02 * int(status["k"])
            self._console.print(f"{seconds:6.2f} s  {' '.join(filter(None, words))}", highlight=False)
