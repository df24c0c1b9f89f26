"""The command of a method of others: its placeholders, and one call with a time limit in a folder of its own.

    python predict.py {before} {after} {out}           {merge} as well, where a merge is given

The command is no shell line: it is split into words like one, and its first word is a program. The command runs
elsewhere, so a word that names a file or folder as seen from where `tunnelcd` was called is made absolute, if it has a
dot or a slash. Others may be names of something else: `train` beside a folder `train`, or `--model=best.pt`.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from cdpipe.core.errors import InputError
from cdpipe.core.names import visible
from cdpipe.core.yamlfile import suggest
from eval.core.provenance import digest_file

SESSION_WORDS = ("before", "after", "out")
MERGE_WORD = "merge"
STDERR_BYTES = 16_000
_PLACEHOLDER = re.compile(r"\{(\w+)\}")
_EXAMPLE = 'expected e.g. --command "python predict.py {before} {after} {out}"'
_TAKES_CODE = ("-c", "-m", "-e")  # options after which no script stands
_SCRIPT_SUFFIXES = (".py", ".sh", ".jl", ".R", ".pl")
_BLOCK_BYTES = 1 << 14
_PIPE_WAIT_S = 5.0


@dataclass(frozen=True, slots=True)
class Ended:
    """How one call of a command ended.

    Attributes:
        seconds: Wall-clock time.
        error: What went wrong, "" for nothing.
        stderr: The last `STDERR_BYTES` bytes of its standard error.
    """

    seconds: float
    error: str
    stderr: str


def parse_command(text: str, *, gets_merge: bool) -> tuple[str, ...]:
    """Return the words of a command; those with a dot or a slash that name a file or folder are made absolute.

    Raises:
        InputError: It is no command, its program or script is not found, a placeholder is missing or unknown, a word
            is not UTF-8, or {merge} stands there where no merge is given, or does not where one is.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"--command {text!r}: {error}: {_EXAMPLE}") from error
    if not words:
        raise InputError(f"--command is empty: {_EXAMPLE}")
    _check_placeholders(text, gets_merge=gets_merge)
    _check_script(words[1:])
    words = [_find_program(words[0]), *map(_make_absolute, words[1:])]
    _check_utf8(words)
    return tuple(words)


def digest_programs(words: Sequence[str]) -> dict[str, str]:
    """Return the SHA-256 of each file that a command names, by its word: the program text that answers.

    A program that is named without a folder is looked up in the PATH and has none.

    Raises:
        InputError: A file cannot be read.
    """
    named = [word for word in words[:1] if os.sep in word] + [word for word in words[1:] if "{" not in word]
    return {word: _digest_file(Path(word)) for word in named if _is_there(word) and Path(word).is_file()}


def run_command(words: Sequence[str], places: Mapping[str, Path], folder: Path, limit_s: float) -> Ended:
    """Run a command with its placeholders filled in, and end its process group when it ends or its time is up.

    What the command starts is in its group, unless it starts a session or a group of its own: that lives on.

    Args:
        words: As `parse_command` returns them.
        places: What stands for each placeholder.
        folder: Its working folder.
        limit_s: Its time limit, wall clock.
    """
    argv = [_PLACEHOLDER.sub(lambda found: str(places.get(found[1], found[0])), word) for word in words]
    start = time.perf_counter()
    try:
        process = subprocess.Popen(
            argv, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            start_new_session=True,
        )  # fmt: skip
    except OSError as error:
        return Ended(0.0, f"the command could not be started: {error.strerror}", "")
    tail = bytearray()
    assert process.stderr is not None
    reader = threading.Thread(target=_keep_tail, args=(process.stderr, tail), daemon=True)
    reader.start()
    try:
        code: int | None = process.wait(limit_s)
    except subprocess.TimeoutExpired:
        code = None
    finally:
        seconds = time.perf_counter() - start
        _end_all(process)
        reader.join(_PIPE_WAIT_S)
    stderr = tail.decode(errors="replace")
    return Ended(seconds, _explain(code, limit_s, stderr), stderr)


def _check_placeholders(text: str, *, gets_merge: bool) -> None:
    found = set(_PLACEHOLDER.findall(text))
    known = (*SESSION_WORDS, MERGE_WORD)
    if unknown := sorted(found - set(known)):
        near = suggest(unknown[0], known) or ": known are " + ", ".join(f"{{{name}}}" for name in known)
        raise InputError(f"--command: {{{unknown[0]}}} is unknown{near}")
    if missing := [name for name in SESSION_WORDS if name not in found]:
        raise InputError(f"--command: {{{missing[0]}}} is missing: {_EXAMPLE}")
    if gets_merge and MERGE_WORD not in found:
        raise InputError("--command: {merge} is missing, and --merge says that one is given: add it, or --merge own")
    if not gets_merge and MERGE_WORD in found:
        raise InputError("--command: {merge} needs --merge given (by the truth) or --merge ours (by tunnelcd)")


def _check_utf8(words: Sequence[str]) -> None:
    """Refuse words that no evaluation.json can hold."""
    for word in words:
        try:
            word.encode()
        except UnicodeEncodeError as error:
            raise InputError(f"--command: {visible(word)} is not UTF-8: give the file another name") from error


def _find_program(word: str) -> str:
    found = shutil.which(word)
    if found is None:
        raise InputError(f"--command: {visible(word)}: no such program: name one of the PATH, or its file")
    # a program of the PATH keeps its name: links of virtual environments look at the name that they are called by
    return str(Path(found).absolute()) if os.sep in word else word


def _check_script(words: Sequence[str]) -> None:
    """Refuse a script that does not exist: the command would fail on every pair, after all are simulated."""
    word = next((word for word in words if not word.startswith("-") or word in _TAKES_CODE), "")
    script = Path(word)
    if script.suffix not in _SCRIPT_SUFFIXES or "{" in word or _is_there(word):
        return
    others = script.parent.glob(f"*{script.suffix}") if _is_there(str(script.parent)) else ()
    beside = (str(script.with_name(each.name)) for each in others)
    raise InputError(
        f"--command: {visible(word)}: no such file in {visible(str(Path.cwd()))}{suggest(word, list(beside))}: "
        "name the script by its path from there, or by its whole path"
    )


def _digest_file(path: Path) -> str:
    try:
        return digest_file(path)
    except OSError as error:
        raise InputError(
            f"--command: {visible(str(path))}: cannot be read ({error.strerror}), so a change of it would not be "
            "noticed: make it readable"
        ) from error


def _make_absolute(word: str) -> str:
    is_path = (os.sep in word or "." in word) and "{" not in word
    return str(Path(word).absolute()) if is_path and _is_there(word) else word


def _is_there(word: str) -> bool:
    """Tell whether a word names a file or folder; one that no file can have as its name does not."""
    try:
        return Path(word).exists()
    except OSError:
        return False


def _keep_tail(stream: BinaryIO, tail: bytearray) -> None:
    """Read a stream to its end and keep its last bytes."""
    with stream:
        while block := os.read(stream.fileno(), _BLOCK_BYTES):
            tail += block
            del tail[:-STDERR_BYTES]


def _end_all(process: subprocess.Popen[bytes]) -> None:
    """End a process and what it started in its process group and left behind."""
    if sys.platform != "win32":
        with suppress(OSError):  # nothing is left
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()


def _explain(code: int | None, limit_s: float, stderr: str) -> str:
    """Return why a call counts as failed, "" where it does not."""
    if code == 0:
        return ""
    if code is None:
        return f"the command took longer than {limit_s:g} s"
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    return f"the command ended with {how}" + (f": {visible(lines[-1])[:500]}" if lines else "")
