"""The program `tunnelcd` from its first moment, before the packages of the command line are imported.

Ctrl-C, SIGTERM and SIGHUP end it in one line. A folder or module called `eval`, `scenarios` or `sim` that hides one of
ours is named: PYTHONPATH and the script's folder come before the installed packages.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from types import FrameType

_HOME = Path(__file__).resolve().parents[2]
_PACKAGES = ("eval", "scenarios", "sim")


def main() -> None:
    """Run the command line and exit; an interrupt before it runs ends with exit code 130, as one while it runs."""
    open_closed_streams()
    handlers = {number: signal.signal(number, _leave) for number in _heeded_signals()}
    _require_working_folder()
    for name in _PACKAGES:
        if other := find_hiding(name):
            sys.stderr.write(
                f"error: {other}: hides the package {name} of tunnelcd, as it comes first on Python's path: rename it, "
                "or leave its folder out of PYTHONPATH\n"
            )
            raise SystemExit(2)
    import_charts()
    run = importlib.import_module("eval.cli.main").main
    for number, handler in handlers.items():
        signal.signal(number, handler)
    run()


def open_closed_streams() -> None:
    """Lead standard streams that whoever started this process has closed (`>&-`) to nowhere; Python has None there."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115 - as long as the process lives
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def find_hiding(name: str) -> str:
    """Return the file or folder that is imported under the name of a package of ours in its place; "" if none is."""
    found = importlib.util.find_spec(name)
    places = [Path(place).resolve() for place in (found.submodule_search_locations or ())] if found else []
    if found is None or _HOME / name in places:
        return ""
    return str(found.origin or places[0])


def import_charts() -> None:
    """Import matplotlib from another folder where the working folder holds a `matplotlibrc`.

    Whoever made that folder would choose how charts look, and which program sets their text; of a pipe, no command
    would end.
    """
    if not os.path.lexists("matplotlibrc"):
        return
    here = Path.cwd()
    os.chdir(_HOME)
    try:
        with suppress(ImportError):
            importlib.import_module("matplotlib")
    finally:
        os.chdir(here)


def _heeded_signals() -> list[int]:
    """Return Ctrl-C and those signals that would end this process; `nohup` lets it ignore SIGHUP."""
    ending = [int(getattr(signal, name)) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    return [int(signal.SIGINT), *(number for number in ending if signal.getsignal(number) == signal.SIG_DFL)]


def _require_working_folder() -> None:
    """End in one line where there is none: a library that is imported later ends the process with words of its own."""
    try:
        Path.cwd()
    except OSError as error:
        sys.stderr.write("error: the working folder was removed: change to one that is there\n")
        raise SystemExit(2) from error


def _leave(number: int, _frame: FrameType | None) -> None:
    """End at once: nothing was begun, and an exception inside an import may be swallowed there."""
    by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
    with suppress(OSError):  # the terminal may be gone
        sys.stderr.write(f"interrupted{by}; nothing was written\n")
        sys.stderr.flush()
    os._exit(128 + number)
