"""Draw the search of the example in docs/planner.md: `python tools/search_figure.py`."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hmc.cli import command_line, one_line_errors  # noqa: E402
from tools.figures import search  # noqa: E402
from tools.study import can_write  # noqa: E402


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


def main(args: Args) -> None:
    """Run the example, draw its search."""
    with one_line_errors():
        can_write(args.out)
        search(args.out, example()["plan"])
    print(args.out)


if __name__ == "__main__":
    main(command_line(Args))
