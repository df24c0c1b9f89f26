import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save

from cdpipe.core.errors import InputError
from cdpipe.core.files import ArraySpec, read_tensors

SPECS = {
    "images": ArraySpec("K,...", "float16"),
    "labels": ArraySpec("K", "uint8"),
    "is_covered": ArraySpec("K", "bool"),
    "step": ArraySpec("", "float32", is_optional=True),
}
ARRAYS = {
    "images": np.arange(24, dtype=np.float16).reshape(2, 3, 4),
    "labels": np.array([1, 2], np.uint8),
    "is_covered": np.array([True, False]),
    "step": np.array(3.0, np.float32),
}


def test_what_safetensors_writes_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(save(ARRAYS, {"about": "x"}))
    arrays, metadata = read_tensors(tmp_path / "a", SPECS)
    assert metadata == {"about": "x"} and set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)
        assert arrays[name].dtype == array.dtype and arrays[name].flags.writeable
    assert list(read_tensors(tmp_path / "a", SPECS, ("labels",))[0]) == ["labels"]


def _file(table: Any, data: bytes = b"", n_table: int | None = None) -> bytes:
    text = json.dumps(table).encode() if not isinstance(table, bytes) else table
    return struct.pack("<Q", len(text) if n_table is None else n_table) + text + data


def _entry(dtype: Any = "U8", shape: Any = (4,), offsets: Any = (0, 4)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"", "cut short"),
        (b"\1", "cut short"),
        (_file({}, n_table=2**63), "its table is said to be"),
        (_file({}, n_table=100), "its table is said to be"),
        (_file(b"[]"), "no JSON object"),
        (_file(b"{"), "Expecting"),
        (_file(b"[" * 100_000), "nested deeper|Expecting"),
        (_file(b'{"a": 1, "a": 2}'), "stands there twice"),
        (_file({"__metadata__": {"a": 1}}), "no table of texts"),
        (_file({"a": 1}), "no tensor of numbers"),
        (_file({"a": _entry("F8_E4M3")}), "no tensor of numbers"),
        (_file({"a": _entry(shape=3)}), "no tensor of numbers"),
        (_file({"a": _entry(offsets=[0, 1, 2])}), "no tensor of numbers"),
        (_file({"a": _entry(shape=[-4])}, bytes(4)), "no whole number"),
        (_file({"a": _entry(shape=[2**40])}, bytes(4)), "declares 1099511627776 bytes"),
        (_file({"a": _entry(shape=[2**40, 2**40], offsets=[0, 2**63])}), "declares"),
        (_file({"a": _entry(shape=[2**63] * 100_000 + [0], offsets=[0, 0])}), "100001 axes, more than 32"),
        (_file({"a": _entry(offsets=[1, 5])}, bytes(5)), "at 1 to 5, not at 0"),
        (_file({"a": _entry(), "b": _entry()}, bytes(4)), "at 0 to 4, not at 4"),
        (_file({"a": _entry()}, bytes(5)), "its tensors end at byte"),
        (_file({"a": _entry()}, bytes(3)), "its tensors end at byte"),
    ],
)
def test_a_damaged_table_is_named(tmp_path: Path, content: bytes, told: str) -> None:
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(InputError, match=rf"a: damaged \(.*({told})") as caught:
        read_tensors(tmp_path / "a", lambda types: None, remedy="make it again")
    assert "\n" not in str(caught.value) and str(caught.value).endswith(": make it again")


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"images": np.zeros(2, np.float16)}, r"images must be \(K, ...\), got \(2,\)"),
        ({"labels": np.zeros(3, np.uint8)}, r"labels must be \(K=2\), got \(3,\)"),
        ({"labels": np.zeros(2, np.int8)}, "labels must be uint8, got int8"),
        ({"images": np.full((2, 1), np.nan, np.float16)}, "images holds numbers that are not finite"),
        ({"is_covered": np.array([2, 0], np.uint8).view(bool)}, "neither true nor false"),
        ({"more": np.zeros(1)}, "'more' is unknown"),
    ],
)
def test_other_tensors_are_named(tmp_path: Path, change: dict[str, np.ndarray], told: str) -> None:
    (tmp_path / "a").write_bytes(save({**ARRAYS, **change}))
    with pytest.raises(InputError, match=told):
        read_tensors(tmp_path / "a", SPECS)


def test_a_file_that_is_cut_while_it_is_read_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(save({**ARRAYS, "images": np.zeros((4096, 8, 8), np.float16)}))

    def cut(types: object) -> None:
        os.truncate(path, 4096)  # its table is read, its tensors are not

    with pytest.raises(InputError, match=r"a: damaged \(cut short while it is read\): make it again"):
        read_tensors(path, cut, remedy="make it again")
