"""How a program ends: a mistake of the user is one line on standard error with exit code 2."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import NoReturn

import typer

from cdpipe.core.errors import TunnelcdError
from cdpipe.core.names import visible
from cdpipe.core.program import open_closed_streams
from eval.core.terminal.interrupts import interruptible, interrupts_kept, tell_interrupt

# A full disk, a read-only one, a file too large for it, a folder or file of another user.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EACCES, errno.EPERM)
# A name that no file can have, or that is another's: of a folder, below a file, in a circle of links, with files in it.
_NAME_ERRORS = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.ENOTEMPTY)
# A disk that fails, or a network disk on which another machine has removed the file.
_FAILURES = (errno.EIO, errno.ESTALE)
_WAYS = {
    **dict.fromkeys(_DISK_ERRORS, "give it a disk with room and leave to write"),
    **dict.fromkeys(_NAME_ERRORS, "name another one"),
    errno.EAGAIN: "wait until it ends, or name another",
    **dict.fromkeys(_FAILURES, "the disk, or the network to it, failed: start the command again once it works"),
}
# Two commands make worlds; the others have methods alone.
_NO_WORLD = ("No such option: --world", "No such option: --world, which changes a world: a method is changed by --set")


@contextmanager
def input_errors() -> Iterator[None]:
    """Turn mistakes of the user into one line each and exit code 2; any other error stays a traceback."""
    try:
        yield
    except TunnelcdError as error:
        for line in str(error).split("\n"):
            _tell(f"error: {visible(line)}")
        raise SystemExit(2) from error
    except OSError as error:
        way = _WAYS.get(error.errno or 0)
        if way is None:
            raise
        unnamed = "a file" if error.errno in _FAILURES else "the output"
        what = visible(f"{error.filename2 or error.filename or unnamed}: {error.strerror}")
        _tell(f"error: {what}: {way}")
        raise SystemExit(2) from error
    except MemoryError as error:  # numpy's says how much was asked for
        said = visible(" ".join(str(error).split())) or "no more can be had"
        _tell(f"error: more memory is needed than there is ({said}): give it smaller inputs")
        raise SystemExit(2) from error


def run_program(command: Callable[..., None], module: str) -> NoReturn:
    """Run a module's command with the arguments of this process and exit, as `tunnelcd` runs its commands."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command)
    run_app(app, f"python -m {module}", sys.argv[1:])


def run_app(app: typer.Typer, name: str, words: Sequence[str], subcommands: Sequence[str] = ()) -> NoReturn:
    """Run a typer application and exit.

    Exit codes: 0 done, 2 mistake of the user (one line each), 1 bug (traceback), 128 + n signal n (Ctrl-C: 130).

    Args:
        app: The application.
        name: The program as the user calls it, for messages.
        words: The arguments.
        subcommands: Names of the application's commands; a mistake in one of them names that command's --help.
    """
    open_closed_streams()
    try:
        with interruptible(), _told_interrupts(), input_errors(), interrupts_kept():
            code = app(args=list(words), prog_name=name, standalone_mode=False)
    except typer.TyperException as error:
        command = " ".join([name, *(word for word in words[:1] if word in subcommands)])
        # typer alone would draw a box; "Value error" is pydantic's, and choices come one a line
        message = " ".join(error.format_message().replace("Value error, ", "").split()).rstrip(".")
        message = message.replace(*_NO_WORLD)
        if message:  # there is none for `tunnelcd` alone, which has printed its help
            _tell(f"error: {command}: {visible(message)}: `{command} --help` lists its arguments")
        raise SystemExit(error.exit_code) from error
    raise SystemExit(code)


@contextmanager
def _told_interrupts() -> Iterator[None]:
    """End an interrupt in one line; of a command's own work, the command has said what is kept."""
    try:
        yield
    except (typer.Abort, KeyboardInterrupt) as error:
        raise SystemExit(tell_interrupt("nothing was written")) from error


def _tell(line: str) -> None:
    with suppress(OSError):  # the terminal may be gone
        sys.stderr.write(f"{line}\n")
