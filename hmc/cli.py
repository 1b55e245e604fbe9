"""What the programs share: a mistake of the user ends in one line, not in a traceback."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Exit with status 2 and one line on ValueError and OSError, which is what bad input raises.

    For the part of a program that reads what the user gave. HMC_TRACEBACK=1 shows where it came from.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        if os.environ.get("HMC_TRACEBACK"):
            raise
        text = " ".join(str(error).split())
        print(f"error: {text}", file=sys.stderr)
        raise SystemExit(2) from None
