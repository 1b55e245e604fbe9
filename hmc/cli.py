"""What the programs share: a mistake of the user ends in one line, not in a traceback."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, TextIO


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Exit with status 2 and one line on ValueError and OSError, which is what bad input raises.

    For the part of a program that reads what the user gave. HMC_TRACEBACK=1 shows where it came from.
    What warns of something meanwhile, such as a driver that lacks something, has one line for it, too.
    """
    shown = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category is UserWarning:
            print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)
        else:
            shown(message, category, filename, lineno, file, line)

    warnings.showwarning = show
    try:
        yield
    except (ValueError, OSError) as error:
        if os.environ.get("HMC_TRACEBACK"):
            raise
        text = " ".join(str(error).split())
        print(f"error: {text}", file=sys.stderr)
        raise SystemExit(2) from None
    finally:
        warnings.showwarning = shown


def command_line(kind: Any, args: Sequence[str] | None = None) -> Any:
    """What a command line says, as `kind`; see `tyro.cli`.

    An option that is given several times, such as --set, takes all of its values: tyro by itself takes the
    last of them, and a run goes on without the others.
    """
    import tyro

    return tyro.cli(kind, args=_gathered(sys.argv[1:] if args is None else args))


def _gathered(words: Sequence[str]) -> list[str]:
    """A command line whose options come once, each with all its values, where it comes first."""
    groups: dict[str, list[str]] = {"": []}
    option = ""
    for word in words:
        if word.startswith("--"):
            option, equals, value = word.partition("=")
            groups.setdefault(option, [option]).extend([value] if equals else [])
        else:
            groups[option].append(word)
    return [word for group in groups.values() for word in group]
