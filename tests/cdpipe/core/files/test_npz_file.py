import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, read_npz

SPECS = {
    "points": ArraySpec("N,3", "float32"),
    "scores": ArraySpec("N", "float64", is_finite=False),
    "masks": ArraySpec("N", "bool", is_optional=True),
    "name": ArraySpec("", "str", is_optional=True),
}


def _write(path: Path, *, compress: bool = False, **arrays: np.ndarray) -> Path:
    (np.savez_compressed if compress else np.savez)(path, **arrays)
    return path


def _arrays(n: int = 4) -> dict[str, np.ndarray]:
    points = np.arange(3.0 * n, dtype=np.float32).reshape(n, 3)
    return {"points": points, "scores": np.full(n, np.nan), "masks": np.ones(n, dtype=bool), "name": np.array("a")}


@pytest.mark.parametrize("compress", [False, True])
def test_what_numpy_writes_is_read(tmp_path: Path, compress: bool) -> None:
    arrays = _arrays()
    read = read_npz(_write(tmp_path / "a.npz", compress=compress, **arrays), SPECS, lengths={"N": 4})
    assert list(read) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype and read[name].flags.writeable


def test_other_orders_of_bytes_and_axes_are_read(tmp_path: Path) -> None:
    points = np.asfortranarray(np.arange(6, dtype=">f4").reshape(2, 3))
    read = read_npz(_write(tmp_path / "a.npz", points=points, scores=np.zeros(2)), SPECS)["points"]
    np.testing.assert_array_equal(read, points)
    assert read.dtype == np.float32 and read.dtype.isnative


@pytest.mark.parametrize("description", ["described", "plain"])
def test_an_archive_that_was_written_to_a_pipe_is_read(tmp_path: Path, description: str) -> None:
    class Pipe(io.RawIOBase):
        content = b""

        def writable(self) -> bool:
            return True

        def write(self, part: bytes) -> int:  # type: ignore[override]
            self.content += bytes(part)
            return len(part)

    pipe = Pipe()
    target = pipe if description == "described" else io.BytesIO()
    np.savez(target, points=np.ones((2, 3), np.float32), scores=np.zeros(2))
    (tmp_path / "a.npz").write_bytes(pipe.content or target.getvalue())  # type: ignore[union-attr]
    assert read_npz(tmp_path / "a.npz", SPECS)["points"].shape == (2, 3)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"points": None}, "points is missing"),
        ({"more": np.zeros(1)}, "'more' is unknown"),
        ({"points": np.zeros((4, 3))}, "points must be float32, got float64"),
        ({"points": np.zeros((4, 2), np.float32)}, r"points must be \(N=4, 3\), got \(4, 2\)"),
        ({"scores": np.zeros(5)}, r"scores must be \(N=4\), got \(5,\)"),
        ({"points": np.full((4, 3), np.inf, np.float32)}, "points holds numbers that are not finite"),
        ({"masks": np.full(4, 2, np.uint8).view(bool)}, "neither true nor false"),
        ({"name": np.array(["a"])}, r"name must be \(\), got \(1,\)"),
        ({"points": np.array([{}] * 4, dtype=object)}, "unreadable"),
        ({"points": np.zeros(4, dtype=[("x", "f4")])}, "no plain array"),
        ({"name": np.array(b"a")}, "no plain array"),
    ],
)
def test_other_arrays_are_named(tmp_path: Path, change: dict[str, np.ndarray | None], told: str) -> None:
    arrays = {name: array for name, array in {**_arrays(), **change}.items() if array is not None}
    with pytest.raises(InputError, match=told) as caught:
        read_npz(_write(tmp_path / "a.npz", **arrays), SPECS, lengths={"N": 4}, remedy="make it again")
    assert "\n" not in str(caught.value) and str(caught.value).endswith(": make it again")


def _without_last_entry(content: bytes) -> bytes:
    """Drop the last entry of the directory, and say so in the record at the end: bits that may flip."""
    last = content.rindex(b"PK\x01\x02")
    end = content.rindex(b"PK\x05\x06")
    n, size, begin = content[end + 8], *struct.unpack_from("<2L", content, end + 12)
    record = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, n - 1, n - 1, size - (end - last), begin, 0)
    return content[:last] + record


def _without_first_entry(content: bytes) -> bytes:
    """Let the directory begin at its second entry."""
    end = content.rindex(b"PK\x05\x06")
    n, size, begin = content[end + 8], *struct.unpack_from("<2L", content, end + 12)
    entry = content.index(b"PK\x01\x02", begin + 1) - begin
    return content[:end] + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, n - 1, n - 1, size - entry, begin + entry, 0)


@pytest.mark.parametrize(
    "damage",
    [
        _without_last_entry,
        _without_first_entry,
        lambda content: content + b"\0",
        lambda content: b"\0" + content,
        lambda content: content[:-1],
        lambda content: content[:-2] + b"\1\0",
        lambda content: content.replace(b"PK\x05\x06" + b"\0" * 4 + b"\4", b"PK\x05\x06" + b"\0" * 4 + b"\3"),
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: content.replace(b"scores.npy", b"points.npy"),
        lambda content: content.replace(b".npy", b".txt"),
        lambda content: content.replace(b"NUMPY\x01", b"NUMPY\x09"),
        lambda content: content.replace(b"NUMPY", b"NAMPY"),
    ],
)
def test_a_directory_that_loses_an_array_is_noticed(tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    path = _write(tmp_path / "a.npz", **_arrays())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(InputError, match=r"a\.npz: unreadable, the file is damaged or cut short") as caught:
        read_npz(path, SPECS)
    assert "\n" not in str(caught.value)


def test_no_flipped_bit_changes_what_is_read(tmp_path: Path) -> None:
    arrays = _arrays()
    content = bytearray(_write(tmp_path / "a.npz", **arrays).read_bytes())
    draw = np.random.default_rng(0)
    n_refused = 0
    for bit in [*draw.integers(0, 8 * len(content), 300), *range(8 * (len(content) - 22), 8 * len(content))]:
        content[bit // 8] ^= 1 << (bit % 8)
        (tmp_path / "a.npz").write_bytes(content)
        content[bit // 8] ^= 1 << (bit % 8)
        try:
            read = read_npz(tmp_path / "a.npz", SPECS)
        except InputError:
            n_refused += 1
            continue
        assert list(read) == list(arrays)
        for name, array in arrays.items():
            np.testing.assert_array_equal(read[name], array)
    assert n_refused > 200


def _member(shape: str, values: bytes, kind: str = "<f4") -> bytes:
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + values


def _archive(path: Path, method: int, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ("(1099511627776,)", "<f4"),
        ("(4611686018427387904, 4611686018427387904)", "<f4"),
        ("(-1,)", "<f4"),
        ("(0, 4611686018427387904)", "<f4"),
        ("(5,)", "<U0"),
        ("(5,)", "|V0"),
        ("(5,)", "|O"),
        ("(" * 400, "<f4"),
        ("(True,)", "<f4"),
        ("(1.0,)", "<f4"),
        ("__import__('os')", "<f4"),
    ],
)
def test_a_declared_size_is_held_against_the_file(tmp_path: Path, shape: str, kind: str) -> None:
    path = _archive(tmp_path / "a.npz", zipfile.ZIP_STORED, points=_member(shape, b"", kind))
    with pytest.raises(InputError, match="unreadable"):
        read_npz(path, SPECS)


def test_a_file_that_would_fill_the_memory_is_not_expanded(tmp_path: Path) -> None:
    n_values = 40 << 20
    path = _archive(tmp_path / "a.npz", zipfile.ZIP_DEFLATED, points=_member(f"({n_values},)", bytes(4 * n_values)))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(InputError, match="bytes would expand to"):
        read_npz(path, SPECS)


def test_a_size_that_the_directory_hides_is_not_expanded(tmp_path: Path) -> None:
    path = _archive(tmp_path / "a.npz", zipfile.ZIP_DEFLATED, points=_member("(1000000,)", bytes(4_000_000)))
    content = path.read_bytes()
    real = struct.pack("<L", len(_member("(1000000,)", bytes(4_000_000))))
    path.write_bytes(content.replace(real, struct.pack("<L", 100)))
    with pytest.raises(InputError, match="unreadable"):
        read_npz(path, SPECS)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_methods_of_compression_are_refused(tmp_path: Path, method: int) -> None:
    path = _archive(tmp_path / "a.npz", method, points=_member("(1,)", bytes(4)))
    with pytest.raises(InputError, match="compressed by a method that is not read"):
        read_npz(path, SPECS)
