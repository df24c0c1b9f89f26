"""The program `tunnelcd` from its first moment: Ctrl-C ends it in one line while its parts are imported, too."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command line and exit; an interrupt before it runs ends with exit code 130, as one while it runs."""
    handler = signal.signal(signal.SIGINT, _leave)
    from eval.cli.main import main as run  # noqa: PLC0415 - no import may come before the handler

    signal.signal(signal.SIGINT, handler)
    run()


def _leave(_number: int, _frame: FrameType | None) -> None:
    """End at once: nothing was begun, and an exception inside an import may be swallowed there."""
    sys.stderr.write("interrupted; nothing was written\n")
    sys.stderr.flush()
    os._exit(130)
