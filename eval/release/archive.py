"""The file of a release: digests of its members, the zip archive, and how it is unpacked.

SHA256SUMS has one line per file in the form of `sha256sum`, so that `sha256sum --check SHA256SUMS` checks an unpacked
archive without tunnelcd. Members are in the order of their names and carry no time, owner or mode of the machine.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path, PurePosixPath

from cdpipe.core.errors import InputError
from cdpipe.core.files import opened_zip, read_bytes, read_member, require_plain_file
from cdpipe.core.names import LONGEST, visible
from cdpipe.core.whole_file import whole_file
from eval.core.output import new_folder
from eval.core.provenance import digest_file
from eval.core.terminal.progress import RunProgress, Silent

SESSIONS, TRUTH, SUMS = "sessions", "truth", "SHA256SUMS"
_MOST_BYTES = 4 << 30
_LONGEST_NAME = 1000  # with folders; systems take paths of 4096 bytes
_LINE = re.compile(r"([0-9a-f]{64})  ([\w.-]+(?:/[\w.-]+)*)")
_NAME = re.compile(r"(sessions|truth)/([0-9a-f]{16})/(.+)")
_EXPECTED = "expected a file made by `tunnelcd dataset --release`, copy it again"


def list_files(folder: Path) -> list[str]:
    """Return the names of all files below a folder, with slashes, sorted."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def write_sums(folder: Path, progress: RunProgress | None = None) -> None:
    """Write SHA256SUMS of all other files of a folder."""
    names = [name for name in list_files(folder) if name != SUMS]
    lines = []
    for done, name in enumerate(names):
        (progress or Silent()).stage("digests", done, len(names))
        lines.append(f"{digest_file(folder / name)}  {name}\n")
    write_sums_of(folder, lines)


def write_sums_of(folder: Path, lines: list[str]) -> None:
    """Write SHA256SUMS with these lines, complete or not at all."""
    with whole_file(folder / SUMS) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def read_sums(folder: Path) -> dict[str, str]:
    """Return the digests of SHA256SUMS by the names of the files.

    Raises:
        InputError: A line of it is malformed.
    """
    return _parse_sums(read_bytes(folder / SUMS), str(folder / SUMS))


def pack(folder: Path, file: Path, progress: RunProgress | None = None) -> None:
    """Write a zip archive of a folder: the same files give the same bytes with the same zlib.

    Raises:
        InputError: It grows larger than what `unpack_release` takes.
    """
    names = list_files(folder)
    with file.open("wb") as stream, zipfile.ZipFile(stream, "w") as archive:
        for done, name in enumerate(names):
            (progress or Silent()).stage("archive", done, len(names))
            member = zipfile.ZipInfo(name)  # the start of 1980
            member.compress_type, member.create_system, member.external_attr = zipfile.ZIP_DEFLATED, 3, 0o644 << 16
            member.file_size = (folder / name).stat().st_size
            with (folder / name).open("rb") as source, archive.open(member, "w") as target:
                shutil.copyfileobj(source, target, 1 << 20)
            _require_unpackable(stream.tell(), folder)
    _require_unpackable(file.stat().st_size, folder)


def _require_unpackable(n_bytes: int, folder: Path) -> None:
    if n_bytes > _MOST_BYTES:
        raise InputError(
            f"{folder}: its archive is larger than the {_MOST_BYTES >> 20} MB that can be unpacked again: the pairs "
            "stay here; make releases of fewer pairs, or name this folder with --out"
        )


def unpack_release(file: Path, out: Path, *, with_truth: bool = False, progress: RunProgress | None = None) -> int:
    """Unpack the pairs of a release, and compare the digests of all files on the way.

    Args:
        file: The archive.
        out: A new or empty folder: `out/<opaque name>/before`, `after`; with truth as `tunnelcd simulate` writes pairs,
            and pairs.csv says which is which.
        with_truth: Whether truth is unpacked.
        progress: Receives the number of files.

    Returns:
        How many pairs were unpacked.

    Raises:
        InputError: The archive is damaged, a digest differs, or `out` cannot be written.
    """
    pairs = set()
    n_bytes = require_plain_file(file, _MOST_BYTES, _EXPECTED)
    with opened_zip(file, n_bytes, _EXPECTED) as (archive, members), new_folder(out) as partial:
        sums = _read_sums_of(archive, members)
        # truth last: its session.json takes the place of the blind one
        for done, (name, digest) in enumerate(sorted(sums.items())):
            (progress or Silent()).stage("unpacking", done, len(sums))
            content = read_member(archive, members[name]).data
            if hashlib.sha256(content).hexdigest() != digest:
                raise ValueError(f"{name} is not the file that was packed: its digest differs")
            target = _place(name, with_truth=with_truth)
            if target is not None:
                (partial / target).parent.mkdir(parents=True, exist_ok=True)
                (partial / target).write_bytes(content)
                pairs |= {Path(target).parts[0]} if "/" in target else set()
    return len(pairs)


def _place(name: str, *, with_truth: bool) -> str | None:
    """Return where a member is unpacked to; None where it is left out."""
    found = _NAME.fullmatch(name)
    if found is None:
        return {"README.md": "README.md", "truth/pairs.csv": "pairs.csv" if with_truth else None}.get(name)
    kind, pair, rest = found.groups()
    return f"{pair}/{rest}" if kind == SESSIONS or with_truth else None


def _read_sums_of(archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo]) -> dict[str, str]:
    """Return the digests of SHA256SUMS, which must name all other members and nothing else."""
    if SUMS not in members:
        raise ValueError(f"no {SUMS} in it")
    sums = _parse_sums(read_member(archive, members[SUMS]).tobytes(), SUMS)
    if others := sorted({*members} ^ {*sums, SUMS})[:1]:
        raise ValueError(f"{visible(others[0])[:200]} is in the archive or in {SUMS}, not in both")
    return sums


def _parse_sums(content: bytes, source: str) -> dict[str, str]:
    found = {}
    for number, line in enumerate(content.decode("utf-8", "replace").splitlines(), start=1):
        parts = _LINE.fullmatch(line)
        if parts is None or {".", ".."} & set(parts[2].split("/")):
            raise InputError(f"{source}:{number}: expected a SHA-256 and the name of a file: copy the release again")
        found[parts[2]] = parts[1]
    _require_files(found, source)
    return found


def _require_files(names: Collection[str], source: str) -> None:
    """Refuse names that cannot all be files of one folder, also where the disk takes upper and lower case as one.

    Raises:
        InputError: A name is too long, one is another's folder, or two are one name.
    """
    folders = {parent.as_posix().casefold() for name in names for parent in PurePosixPath(name).parents}
    seen = set()
    for name in names:
        way = f"{source}: {visible(name):.100}"
        if len(name) > _LONGEST_NAME or any(len(part.encode()) > LONGEST for part in name.split("/")):
            raise InputError(f"{way}: longer than a file's name can be: copy the release again")
        if name.casefold() in folders:
            raise InputError(f"{way}: a file and a folder of one name: copy the release again")
        if name.casefold() in seen:
            raise InputError(f"{way}: stands twice: copy the release again")
        seen.add(name.casefold())
