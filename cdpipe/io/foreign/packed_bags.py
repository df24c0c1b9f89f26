"""ROS 2 bags with compressed files, as `--compression-mode file` writes them: decompressed before they are read."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from cdpipe.core.errors import InputError
from cdpipe.core.isolated_reader import IsolatedReader
from cdpipe.io.foreign.bag_layout import METADATA

# The scans are written to the same disk afterwards.
_SHARE_OF_FREE_SPACE = 0.5


def unpack_bag(path: Path, reader: IsolatedReader) -> Path | None:
    """Decompress a bag into a folder in a new temporary folder, which the caller removes; None for any other bag.

    Args:
        path: The bag.
        reader: Calls `cdpipe.io.foreign.bag_files`, in a process that may write no large file itself.

    Raises:
        InputError: The bag is damaged, or takes more than half of the free space when decompressed.
    """
    if not (path / METADATA).is_file() or all(each.suffix != ".zstd" for each in path.iterdir()):
        return None
    above = Path(tempfile.mkdtemp(prefix="tunnelcd-bag-"))
    out = above / (path.resolve().name or "bag")
    is_whole = False
    try:
        out.mkdir()
        is_whole = _write_files(path, out, reader)
    except OSError as error:
        raise InputError(f"{error.filename or above}: cannot be written: {error.strerror}") from error
    finally:
        if not is_whole:
            shutil.rmtree(above, ignore_errors=True)
    return out if is_whole else None


def _write_files(path: Path, out: Path, reader: IsolatedReader) -> bool:
    """Write the decompressed files of a bag; return whether it has compressed ones."""
    most_bytes = int(_SHARE_OF_FREE_SPACE * shutil.disk_usage(out).free)
    n_bytes = 0
    for about, arrays in reader.read("unpack", path=str(path)):
        if "metadata" in about:
            (out / METADATA).write_text(str(about["metadata"]), encoding="utf-8")
            continue
        n_bytes += arrays["block"].nbytes
        if n_bytes > most_bytes:
            raise InputError(
                f"{path}: its files take more than {most_bytes / 1e9:.1f} GB when decompressed, half of what is free "
                f"in {out.parent.parent}: decompress them elsewhere by unzstd and name the .db3 or .mcap, or set TMPDIR"
            )
        with (out / Path(str(about["file"])).name).open("ab") as file:
            file.write(arrays["block"].data)
    return n_bytes > 0
