from __future__ import annotations

import os
from pathlib import Path

import meshio
import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.io.ply import read_ply_points, write_ply_points

POINTS = np.array([[1.5, -2.0, 3.25], [4.0, 5.0, -6.5]])


def header(encoding: str, n: int, properties: str = "float x|float y|float z", more: str = "") -> bytes:
    lines = ["ply", f"format {encoding} 1.0", "comment made by a test", f"element vertex {n}"]
    lines += [f"property {entry}" for entry in properties.split("|")]
    return "\n".join([*lines, *([more] if more else []), "end_header", ""]).encode()


def test_what_meshio_writes_is_read_alike(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    for binary in (True, False):
        path = tmp_path / f"{binary}.ply"
        meshio.ply.write(path, meshio.Mesh(points, [], point_data={"intensity": np.arange(50.0)}), binary=binary)
        np.testing.assert_array_equal(read_ply_points(path), points)


def test_other_properties_and_elements_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    camera = "element camera 1\nproperty float view_px"
    path.write_bytes(
        header("ascii", 2, "uchar ring|float z|float x|float y", camera) + b"7 3.25 1.5 -2\n8 -6.5 4 5\n0\n"
    )
    np.testing.assert_array_equal(read_ply_points(path), POINTS)
    table = np.zeros(2, dtype=[("ring", "u1"), ("x", ">f8"), ("y", ">f8"), ("z", ">f8")])
    table["x"], table["y"], table["z"] = POINTS.T
    path.write_bytes(
        header("binary_big_endian", 2, "uchar ring|double x|double y|double z", camera) + table.tobytes() + b"\0\0\0\0"
    )
    np.testing.assert_array_equal(read_ply_points(path), POINTS)


def test_line_ends_of_windows(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    path.write_bytes((header("ascii", 2) + b"1.5 -2 3.25\n4 5 -6.5\n").replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(read_ply_points(path), POINTS)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", 'does not begin with "ply"'),
        (b"\x00\x01", 'does not begin with "ply"'),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n", "no end_header"),
        (header("ascii", 3) + b"1 2 3\n4 5 6\n", "3 vertices"),
        (header("binary_little_endian", 3) + b"\0" * 35, "3 vertices"),
        (header("ascii", 1, "float a|float b") + b"1 2\n", "no x, y and z"),
        (header("ascii", 1, "float x|list uchar int y") + b"1 2\n", '"list" are not supported'),
        (header("ascii", 1) + b"one 2 3\n", "could not convert"),
        (header("ebcdic", 1) + b"1 2 3\n", 'unknown format "ebcdic"'),
        (b"ply\nformat\nelement\nend_header\n", "header line 'format'"),
        (header("ascii", 1).replace(b"vertex 1", b"vertex many") + b"1 2 3\n", "invalid literal"),
    ],
)
def test_a_damaged_file_is_named_with_what_is_wrong(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "broken.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"broken\.ply: ") as caught:
        read_ply_points(path)
    assert said in str(caught.value)


def test_a_real_scan_reads_as_with_meshio() -> None:
    if "TUNNELCD_REAL_DATA" not in os.environ:
        pytest.skip("TUNNELCD_REAL_DATA is unset: real scans are not at hand")
    path = Path(os.environ["TUNNELCD_REAL_DATA"]) / "registration_pair" / "source.ply"
    points = read_ply_points(path)
    assert points.shape == (69792, 3)
    np.testing.assert_array_equal(points, meshio.ply.read(path).points.astype(np.float64))


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_count_beyond_any_file_is_named(tmp_path: Path, kind: str) -> None:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    (tmp_path / "a.ply").write_text(f"ply\nformat {kind} 1.0\nelement vertex {10**29}\n{axes}end_header\n1 2 3\n")
    with pytest.raises(InputError, match="1e\\+29 vertices are announced"):
        read_ply_points(tmp_path / "a.ply")


def test_a_scan_that_was_cut_short_early_says_so_with_the_count_that_its_header_has(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    write_ply_points(path, np.zeros((69_783, 3)))
    path.write_bytes(path.read_bytes()[:5_000])
    with pytest.raises(InputError, match="69783 vertices are announced in a file of 5000 bytes: it is damaged or cut"):
        read_ply_points(path)
