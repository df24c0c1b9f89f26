"""Damages a file's content: at any byte, and knowingly in the structure of its format.

Each mutator takes the content and a `random.Random`, and returns another content; the same generator gives the same.
"""

from __future__ import annotations

import ast
import io
import json
import lzma
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import yaml

Mutator = Callable[[bytes, random.Random], bytes]
_NUMBERS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, (1 << 63) - 1, (1 << 64) - 1)
_WORDS = (
    b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"1e308", b"9" * 30, b"9" * 5000, b"", b"x", b"true", b"\x00",
    b"\xff\xfe", b"\xf0\x9f\x92\xa5", b"\x1b[31m", b"<script>", b"../../x", b"1_0", b"0x10", b"1.5", b"'", b'"', b",",
)  # fmt: skip
_MOST_HELD_BYTES = 10_000_000
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.5, -0.0, 1e308, -1e308, 1e-320, 2**31, 2**53 + 1, 2**63, -(2**63) - 1, 10**400,
    float("nan"), float("inf"), float("-inf"), "", "x", "1", "nan", "\0", "\x1b[31m", "\ud800", "a\nb", "../../x", "/",
    "<!--<script>", "x" * 100_000, [], {}, [[]], [None], {"": ""}, {"x": 1}, [1, 2, 3], ["1"], [float("nan")] * 3,
    [[1.0, 0.0], [0.0]], list(range(1000)), [0.0] * 16, "2020-01-01", "*", "~", "=", "ok", "1-3",
)  # fmt: skip


def mutate(name: str, content: bytes, rng: random.Random) -> bytes:
    """Return a damaged copy of a file's content; its format follows from the file's name."""
    structured = _BY_SUFFIX.get(name.rpartition(".")[2], ())
    for is_second in range(1 + (rng.random() < 0.2)):
        is_structured = structured and rng.random() < 0.65
        mutator = rng.choice(structured if is_structured else _ANYWHERE)
        try:
            content = mutator(content, rng)
        except Exception as error:
            # no number is text and no scalar has parts; after the first damage a mutator may understand nothing at all
            if not is_second and not isinstance(error, ValueError | IndexError):
                raise
            content = flip(content, rng)
    return content


def flip(content: bytes, rng: random.Random) -> bytes:
    """Flip one to eight bits."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 8)) if data else 0):
        data[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(data)


def overwrite(content: bytes, rng: random.Random) -> bytes:
    """Write a number with a meaning to programmers somewhere."""
    data, width = bytearray(content), rng.choice((1, 2, 4, 8))
    at = _place(data, rng)
    number = rng.choice(_NUMBERS) & ((1 << 8 * width) - 1)
    data[at : at + width] = number.to_bytes(width, rng.choice(("little", "big")))
    return bytes(data)


def truncate(content: bytes, rng: random.Random) -> bytes:
    """Cut the end off."""
    return content[: rng.choice((0, 1, len(content) - 1, rng.randrange(len(content) + 1)))]


def duplicate(content: bytes, rng: random.Random) -> bytes:
    """Write a piece twice, the whole file in the worst case."""
    start, end = _range(content, rng)
    return content[:end] + content[start:end] * rng.choice((1, 1, 2, 50)) + content[end:]


def remove(content: bytes, rng: random.Random) -> bytes:
    """Leave a piece out."""
    start, end = _range(content, rng)
    return content[:start] + content[end:]


def splice(content: bytes, rng: random.Random) -> bytes:
    """Write a piece over another one."""
    (start, end), to = _range(content, rng), rng.randrange(len(content) + 1)
    return content[:to] + content[start:end] + content[to + end - start :]


def insert(content: bytes, rng: random.Random) -> bytes:
    """Insert a word with a meaning to parsers."""
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.choice(_WORDS) + content[at:]


def replace_number(content: bytes, rng: random.Random) -> bytes:
    """Write something else where a number stands in a text."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?(e[-+]?\d+)?", content[:200_000]))
    one = rng.choice(found)
    return content[: one.start()] + rng.choice(_WORDS) + content[one.end() :]


def change_lines(content: bytes, rng: random.Random) -> bytes:
    """Drop, repeat, swap or join lines."""
    lines = content.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    kind = rng.randrange(5)
    if kind == 0:
        del lines[a]
    elif kind == 1:
        lines[a:a] = [lines[b]] * rng.choice((1, 1, 100))
    elif kind == 2:
        lines[a], lines[b] = lines[b], lines[a]
    elif kind == 3:
        lines[a] = b" ".join(reversed(lines[a].split()))
    else:
        return (b"\r\n" if rng.random() < 0.5 else b"\r").join(lines)
    return b"\n".join(lines)


def change_encoding(content: bytes, rng: random.Random) -> bytes:
    """Write a text in another encoding, or with a byte-order mark."""
    text = content.decode("utf-8", errors="replace")
    return rng.choice((b"\xef\xbb\xbf" + content, text.encode("utf-16"), text.encode("utf-32"), content + b"\xff"))


def change_json(content: bytes, rng: random.Random) -> bytes:
    """Change a value, a key or the order of a JSON document."""
    return _to_json(_change_tree(json.loads(content), rng))


def nest_json(content: bytes, rng: random.Random) -> bytes:
    """Put deep nesting or a key twice into a JSON text."""
    value = rng.choice((b"[" * 100_000, b"[" * 500 + b"]" * 500, b'{"a":' * 3000 + b"1" + b"}" * 3000, b"9" * 5000))
    kind = rng.randrange(3)
    if kind == 0:
        return value
    if kind == 1:
        return content.replace(b"{", b'{"format": ' + value + b", ", 1)
    first = re.search(rb'"[^"]*":', content)
    return content.replace(b"{", b"{" + (first[0] if first else b'"a":') + b" 1, ", 1)


def change_yaml(content: bytes, rng: random.Random) -> bytes:
    """Change a value, a key or the order of a YAML document."""
    changed = _change_tree(yaml.safe_load(content), rng)
    return yaml.safe_dump(changed, default_flow_style=rng.choice((None, True)), sort_keys=False).encode(
        "utf-8", "replace"
    )


def add_yaml(content: bytes, rng: random.Random) -> bytes:
    """Add what YAML allows and no settings file needs."""
    bomb = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
        f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join([f'*{chr(97 + n)}'] * 9)}]\n" for n in range(12)
    )
    text = rng.choice(
        ("&a [*a]", "a: &a {b: *a}", bomb, "[" * 5000, "[" * 300 + "]" * 300, "{a: " * 2000 + "}" * 2000,
         "a: !!python/object/apply:os.system [true]", "? [a, b]\n: 1", "a: 1\na: 2", "a:\n\t- b", "--- 1\n--- 2",
         "a: !!binary x", "a: !!set {b, c}", "a: !!timestamp 2020-99-99", "a: 190:20:30", "a: 0o777", "a: .nan",
         "a: " + "9" * 5000, "x" * 100_000 + ": 1", "<<: {a: 1}", "<<: *b", "a: *b", "%YAML 9.9\n---\na: 1", "a: |\n b",
         "- " * 3000, "a: !!omap [b: 1]", "!!str : x", "a: !!float x", "a: !!int x", "2020-01-01: 1", "null: 1", "1: 2")
    )  # fmt: skip
    lines = content.decode("utf-8", errors="replace").splitlines()
    kind, at = rng.randrange(4), rng.randrange(len(lines) + 1)
    if kind == 0:
        return text.encode()
    if kind == 1:
        return "\n".join([*lines[:at], text, *lines[at:]]).encode()
    if kind == 2:
        value = text.partition(": ")[2] or text
        return re.sub(r":\s*[^\s:]+\s*$", lambda _: f": {value}", "\n".join(lines), count=1, flags=re.M).encode()
    return "\n".join([*lines, text]).encode()


def change_cells(content: bytes, rng: random.Random) -> bytes:
    """Change a cell, a column or a row of a CSV table."""
    rows = [line.split(b",") for line in content.split(b"\n")]
    row = rng.randrange(len(rows))
    column = rng.randrange(len(rows[row]))
    kind = rng.randrange(6)
    if kind <= 2:
        rows[row][column] = rng.choice((*_WORDS, b"x" * 200_000, b'"unclosed', b"1e400", b"9" * 20, b"True"))
    elif kind == 3:
        rows = [[*cells[:column], *cells[column + 1 :]] for cells in rows]
    elif kind == 4:
        rows[0][column % len(rows[0])] = rng.choice((rows[0][0], b"", b"x", b"Unnamed: 0", b"nan"))
    else:
        rows[row] = rows[row] * 2
    return b"\n".join(b",".join(cells) for cells in rows)


def within_xz(mutator: Mutator) -> Mutator:
    """Return a mutator of what an .xz file holds; of a bomb it damages the file itself."""

    def damage(content: bytes, rng: random.Random) -> bytes:
        held = lzma.LZMADecompressor().decompress(content, max_length=_MOST_HELD_BYTES + 1)
        if len(held) > _MOST_HELD_BYTES or content == _xz_bomb():
            return flip(content, rng)
        return lzma.compress(mutator(held, rng), preset=0)

    return damage


def bomb_xz(content: bytes, rng: random.Random) -> bytes:
    """Return a small file that holds much."""
    return _xz_bomb()


@cache
def _xz_bomb() -> bytes:
    return lzma.compress(b"a,b\n") + lzma.compress(b"1,2\n" * 250_000, preset=0) * 250


def change_zip(content: bytes, rng: random.Random) -> bytes:
    """Change the end record, the central directory or a local header of a zip file."""
    data = bytearray(content)
    signature = rng.choice((b"PK\x05\x06", b"PK\x05\x06", b"PK\x01\x02", b"PK\x03\x04"))
    places = [found.start() for found in re.finditer(re.escape(signature), content)]
    length = {b"PK\x05\x06": 22, b"PK\x01\x02": 46, b"PK\x03\x04": 30}[signature]
    at = rng.choice(places) + rng.randrange(4, length)
    if rng.random() < 0.5:
        data[at] ^= 1 << rng.randrange(8)
    else:
        width = rng.choice((1, 2, 4))
        data[at : at + width] = (rng.choice(_NUMBERS) & ((1 << 8 * width) - 1)).to_bytes(width, "little")
    return bytes(data)


def change_members(content: bytes, rng: random.Random) -> bytes:
    """Drop, rename, repeat, add or empty a member of a zip file."""
    members = _members(content)
    at = rng.randrange(len(members))
    name, data = members[at]
    kind = rng.randrange(7)
    if kind == 0:
        del members[at]
    elif kind == 1:
        members[at] = (rng.choice(("x.npy", "", "../x.npy", "/x.npy", name[:-4], name + ".npy", "a\0.npy")), data)
    elif kind == 2:
        members.append((name, data))
    elif kind == 3:
        members.append((rng.choice(("x.npy", "x.txt", "self.npy", "file.npy", "0.npy")), data))
    elif kind == 4:
        members[at] = (name, b"")
    elif kind == 5:
        members[at] = (name, members[rng.randrange(len(members))][1])
    else:
        return _with_bomb([each for n, each in enumerate(members) if n != at], name)
    return _zipped(members, rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)))


def _with_bomb(members: list[tuple[str, bytes]], name: str) -> bytes:
    """Return a zip file with one member more: 800 MB of zeros as .npy, which deflate packs into less than 1 MB."""
    deflated, checksum, n_bytes = _npy_bomb()
    data = bytearray(_zipped([*members, (name, deflated)]))
    for signature, at in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        start = data.rindex(signature) + at  # method, time, date, checksum, sizes
        struct.pack_into("<H", data, start, zipfile.ZIP_DEFLATED)
        struct.pack_into("<I", data, start + 6, checksum)
        struct.pack_into("<I", data, start + 14, n_bytes)
    return bytes(data)


@cache
def _npy_bomb() -> tuple[bytes, int, int]:
    """Return the deflated content, its checksum and its length; it is never whole in memory."""
    head, piece, times = _npy({"descr": "|u1", "fortran_order": False, "shape": (800 << 20,)}, b""), bytes(1 << 20), 800
    packer = zlib.compressobj(wbits=-15)
    start = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH)
    each = packer.compress(piece) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = zlib.crc32(head)
    for _ in range(times):
        checksum = zlib.crc32(piece, checksum)
    return start + each * times + packer.flush(), checksum, len(head) + times * len(piece)


def change_npy_header(content: bytes, rng: random.Random) -> bytes:
    """Change type, order or shape in the header of an array; checksums stay right."""
    members = _members(content)
    at = rng.randrange(len(members))
    name, data = members[at]
    header, body = _split_npy(data)
    kind = rng.randrange(5)
    if kind == 0:
        header["shape"] = rng.choice(
            ((), (0,), (-1,), (1 << 62,), (10**30,), (1 << 31,) * 2, (3,), (1,) * 40, (1.5,), ("3",), [3], None, (9,))
        )
    elif kind == 1:
        header["descr"] = rng.choice(
            ("|O", "<U5", "<U100000000", "|V8", "|S4", ">f8", "<f2", "<f16", "<c16", "<M8[ns]", "<m8", "x", None,
             [("a", "<f8")], [("a", "<f8", (1 << 40,))], "<i8,<i8", "|V0", "<U0", "<f4", "<i2", "|u1")
        )  # fmt: skip
    elif kind == 2:
        header["fortran_order"] = rng.choice((True, None, "x", 1))
    elif kind == 3:
        header = rng.choice(({}, {**header, "x": 1}, {"descr": header["descr"]}, {1: 2}))
    else:
        text = rng.choice(
            (b"[" * 2000, b"__import__('os')", b"{'shape': " + b"9" * 6000 + b"}", b"\xff" * 10, b"1" * 60_000)
        )
        major = rng.choice((1, 2, 3, 9))
        length = struct.pack("<H" if major == 1 else "<I", rng.choice((len(text), 65_535, 0)))
        members[at] = (name, b"\x93NUMPY" + bytes([major, 0]) + length + text + body)
        return _zipped(members)
    members[at] = (name, _npy(header, body))
    return _zipped(members)


def change_array(content: bytes, rng: random.Random) -> bytes:
    """Change values, shape or type of an array; the file is a right .npz."""
    members = _members(content)
    at = rng.randrange(len(members))
    name, data = members[at]
    array = np.load(io.BytesIO(data), allow_pickle=False)
    kind = rng.randrange(8)
    if kind <= 2 and array.size and array.dtype.kind in "iufb":
        array = array.copy()
        flat = array.reshape(-1)
        places = [rng.randrange(array.size) for _ in range(rng.choice((1, 1, array.size)))]
        with np.errstate(all="ignore"):
            if array.dtype.kind == "f":
                flat[places] = rng.choice((np.nan, np.inf, -np.inf, 1e30, -1e30, 1e300, 1e-320, 0.0, -1.0, 2.0**62))
            else:
                flat[places] = np.array(rng.choice((0, 1, -1, 255, 32767, 2**31 - 1, -(2**31), 2**62))).astype(
                    array.dtype
                )
    elif kind == 3:
        array = rng.choice(
            (array[:0], array.reshape(-1), array[None], array.T, array[..., None], array[:-1], array[:1])
        )
    elif kind == 4:
        with np.errstate(all="ignore"):
            array = array.astype(
                rng.choice(("f8", "f4", "f2", "i8", "u1", "i1", "?", "u8", "c16", "U20", "S5", "M8[s]"))
            )
    elif kind == 5:
        array = np.concatenate([array, array]) if array.ndim else array[None]
    elif kind == 6:
        array = array[::-1].copy() if array.ndim else np.array(0)
    else:
        array = np.array(rng.choice((0, np.nan, "x", True)))
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    members[at] = (name, out.getvalue())
    return _zipped(members)


def change_safetensors(content: bytes, rng: random.Random) -> bytes:
    """Change the JSON header of a safetensors file, its length mended; or the length."""
    length = struct.unpack_from("<Q", content)[0]
    header, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    kind = rng.randrange(5)
    if kind == 0:
        return struct.pack("<Q", rng.choice(_NUMBERS)) + content[8:]
    if kind == 1 and "__metadata__" in header:
        key = rng.choice(list(header["__metadata__"]))
        inner = header["__metadata__"][key].encode()
        changed = rng.choice((change_json, nest_json, flip))(inner, rng)
        header["__metadata__"][key] = changed.decode("utf-8", errors="replace")
    elif kind <= 3:
        tensor = header[rng.choice([name for name in header if name != "__metadata__"])]
        key = rng.choice(("dtype", "shape", "data_offsets"))
        tensor[key] = rng.choice(
            {
                "dtype": ("F64", "F32", "F16", "BF16", "I64", "U8", "BOOL", "X", "", None, "F8_E4M3", "I8"),
                "shape": ([], [0], [1 << 62], [1 << 32] * 2, [-1], [1], None, [1.5], tensor["shape"][::-1], [2] * 70),
                "data_offsets": ([0, 0], [0, 1 << 62], [8, 0], [-1, 4], [0], None, [0, len(body)]),
            }[key]
        )
    else:
        header = _change_tree(header, rng)
    text = _to_json(header)
    return struct.pack("<Q", len(text)) + text + body


def change_ply_header(content: bytes, rng: random.Random) -> bytes:
    """Change a count, a type or a line of a PLY header."""
    end = content.index(b"end_header")
    head, rest = content[:end], content[end:]
    kind = rng.randrange(4)
    if kind == 0:
        count = rng.choice(
            (b"-1", b"0", b"1", b"999999999999", b"9" * 30, b"9" * 5000, b"1.5", b"nan", b"", b"x", b"1_000")
        )
        head = re.sub(rb"(element \w+ )\d+", rb"\g<1>" + count, head, count=rng.choice((1, 2)))
    elif kind == 1:
        kinds = (b"double", b"float", b"uchar", b"int", b"int64", b"list uchar int", b"list double float", b"x", b"")
        found = list(re.finditer(rb"property (\w+)", head))
        one = rng.choice(found)
        head = head[: one.start(1)] + rng.choice(kinds) + head[one.end(1) :]
    elif kind == 2:
        formats = (b"ascii", b"binary_little_endian", b"binary_big_endian", b"x", b"")
        head = re.sub(rb"format \w*", b"format " + rng.choice(formats), head)
    else:
        return change_lines(head, rng) + rest
    return head + rest


def within(mutator: Mutator, first: int, last: int | None = None) -> Mutator:
    """Return a mutator of one part of a file, from byte `first` to byte `last`, as slices count."""

    def damage(content: bytes, rng: random.Random) -> bytes:
        start, end, _ = slice(first, last).indices(len(content))
        return content[:start] + mutator(content[start:end], rng) + content[max(start, end) :]

    return damage


def change_glb(content: bytes, rng: random.Random) -> bytes:
    """Change the JSON of a GLB file, and mend its lengths."""
    end = 20 + struct.unpack_from("<I", content, 12)[0]
    text = change_json(content[20:end], rng)
    text += b" " * (-len(text) % 4)
    lengths = struct.pack("<II", len(content) - end + 20 + len(text), len(text))
    return content[:8] + lengths + content[16:20] + text + content[end:]


def change_e57(content: bytes, rng: random.Random) -> bytes:
    """Change bytes of an E57 file or the text of its XML, and mend its lengths and the checksums of its pages."""
    data = b"".join(content[at : at + 1020] for at in range(0, len(content), 1024))
    if rng.random() < 0.4:
        data = rng.choice((flip, overwrite))(data, rng)[: len(data)]
    else:
        start, n_bytes = data.index(b"<?xml"), struct.unpack_from("<Q", data, 32)[0]
        text = rng.choice((replace_number, replace_number, change_lines, flip))(data[start : start + n_bytes], rng)
        data = data[:32] + struct.pack("<Q", len(text)) + data[40:start] + text
        data += bytes(-len(data) % 1020)
        data = data[:16] + struct.pack("<Q", len(data) // 1020 * 1024) + data[24:]
    pages = (data[at : at + 1020] for at in range(0, len(data), 1020))
    return b"".join(page + _crc32c(page).to_bytes(4, "big") for page in pages)


def _crc32c(data: bytes) -> int:
    found = 0xFFFFFFFF
    for byte in data:
        found ^= byte
        for _ in range(8):
            found = found >> 1 ^ 0x82F63B78 * (found & 1)
    return found ^ 0xFFFFFFFF


def change_osf(content: bytes, rng: random.Random) -> bytes:
    """Change bytes of one block of an OSF file, and mend its checksum."""
    blocks, at = [], 0
    while at + 8 <= len(content):
        end = at + 4 + struct.unpack_from("<I", content, at)[0]
        blocks.append((at, end))
        at = end + 4
    start, end = rng.choice(blocks)
    inner = content[start + 4 : end]
    if rng.random() < 0.6:  # tables and offsets are at both ends
        width = min(len(inner), rng.choice((60, 400, 2000)))
        part = slice(0, width) if rng.random() < 0.5 else slice(len(inner) - width, len(inner))
        inner = inner[: part.start] + rng.choice((flip, overwrite))(inner[part], rng) + inner[part.stop :]
    else:
        inner = rng.choice((flip, overwrite))(inner, rng)
    block = content[start : start + 4] + inner[: end - start - 4]
    return content[:start] + block + struct.pack("<I", zlib.crc32(block)) + content[end + 4 :]


def change_pcap(content: bytes, rng: random.Random) -> bytes:
    """Change the header of a PCAP, of a record, or of a packet's Ethernet, IP, UDP and lidar headers."""
    data = bytearray(content)
    if rng.random() < 0.2:
        data[rng.randrange(24)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
        return bytes(data)
    at, starts = 24, []
    while at + 16 <= len(data) and len(starts) < 10_000:
        starts.append(at)
        at += 16 + struct.unpack_from("<I", data, at + 8)[0]
    start = rng.choice(starts)
    if rng.random() < 0.3:
        struct.pack_into("<I", data, start + rng.choice((0, 4, 8, 12)), rng.choice(_NUMBERS) & 0xFFFFFFFF)
    else:
        for _ in range(rng.choice((1, 1, 4))):
            data[min(start + 16 + rng.randrange(42 + 64), len(data) - 1)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
    return bytes(data)


def change_bag(content: bytes, rng: random.Random) -> bytes:
    """Change numbers beside the name of a frame, which are stamps, poses and sizes of clouds; or the name itself."""
    name = rng.choice((b"base_link", b"os_lidar", b"odom", b"map"))
    places = [found.start() for found in re.finditer(name, content)]
    at = rng.choice(places)
    data = bytearray(content)
    kind = rng.randrange(4)
    if kind == 0:
        others = [other for other in (b"base_link", b"os_lidar", b"odom", b"map", b"../\x1b[2J<") if other != name]
        data[at : at + len(name)] = rng.choice(others)[: len(name)].ljust(len(name), b"_")
    elif kind == 1:
        number = rng.choice(_NUMBERS) & 0xFFFFFFFF
        start = max(0, at + rng.randrange(-24, 160))
        data[start : start + 4] = number.to_bytes(4, "little")
    else:
        value = rng.choice((np.nan, np.inf, -np.inf, 1e300, -1e30, 1e-320, 0.0, 2.0))
        start = at + len(name) + rng.randrange(80)
        data[start : start + 8] = struct.pack("<d", value)
    return bytes(data[: len(content)])


def change_mesh_text(content: bytes, rng: random.Random) -> bytes:
    """Change a vertex or a face of an OBJ file, or add a line that the format knows."""
    line = rng.choice(
        (b"f 1 2 999999999999", b"f 0 0 0", b"f -1 -2 -99", b"f 1/1/1 2//2 3/", b"f 1 2", b"f " + b"1 " * 5000,
         b"v nan 0 0", b"v 1e308 1e308 1e308", b"v", b"v 1", b"mtllib ../../../etc/passwd", b"usemtl x", b"o \xff",
         b"g", b"l 1 2", b"vt 0",
         b"vn 0 0 0", b"s 1", b"f 1 2 3 4 5 6 7 8", b"v 0 0 0 1 1 1", b"\\", b"f 1.5 2 3", b"v 1e-300 0 0")
    )  # fmt: skip
    lines = content.split(b"\n")
    at = rng.randrange(len(lines) + 1)
    return b"\n".join([*lines[:at], line, *lines[at:]])


def _place(data: bytes | bytearray, rng: random.Random) -> int:
    """Return a place in the data: often near its start or end, where headers are."""
    if not data:
        return 0
    near = min(len(data), 128)
    return rng.choice((rng.randrange(len(data)), rng.randrange(near), len(data) - 1 - rng.randrange(near)))


def _range(content: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(content) + 1)
    return start, min(len(content), start + rng.choice((1, 4, 64, 1000, len(content))))


def _change_tree(document: Any, rng: random.Random) -> Any:
    """Change one value, key or list somewhere in a document of dicts and lists."""
    places: list[tuple[Any, Any]] = []

    def visit(value: Any) -> None:
        inner = list(value.items()) if isinstance(value, dict) else list(enumerate(value))
        for key, item in inner:
            places.append((value, key))
            if isinstance(item, dict | list) and len(places) < 20_000:
                visit(item)

    if not isinstance(document, dict | list) or rng.random() < 0.02:
        return rng.choice(_VALUES)
    visit(document)
    if not places:
        return rng.choice(_VALUES)
    holder, key = rng.choice(places)
    kind = rng.randrange(6)
    if kind <= 2:
        holder[key] = rng.choice(_VALUES)
    elif kind == 3:
        del holder[key]
    elif kind == 4 and isinstance(holder, dict):
        holder[rng.choice(("x", "", "__class__", "format", "self", 1, "a.b"))] = holder.pop(key)
    elif isinstance(holder[key], list):
        holder[key] = holder[key] * rng.choice((2, 2, 500))
    else:
        holder[key] = [holder[key]]
    return document


def _to_json(document: Any) -> bytes:
    return json.dumps(document, ensure_ascii=False).encode("utf-8", errors="surrogatepass")


def _members(content: bytes) -> list[tuple[str, bytes]]:
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        if sum(info.file_size for info in file.infolist()) > 50_000_000:
            raise ValueError("damaged before: its members are huge")
        return [(info.filename, file.read(info)) for info in file.infolist()]


def _zipped(members: list[tuple[str, bytes]], method: int = zipfile.ZIP_STORED) -> bytes:
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", method) as file:
        warnings.simplefilter("ignore")  # a name twice is meant
        for name, data in members:
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            file.writestr(info, data)
    return out.getvalue()


def _split_npy(data: bytes) -> tuple[dict[Any, Any], bytes]:
    start, length = (
        (12, struct.unpack_from("<I", data, 8)[0]) if data[6] > 1 else (10, struct.unpack_from("<H", data, 8)[0])
    )
    return ast.literal_eval(data[start : start + length].decode()), data[start + length :]


def _npy(header: dict[Any, Any], body: bytes) -> bytes:
    text = repr(header).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


_ANYWHERE: tuple[Mutator, ...] = (flip, flip, overwrite, truncate, duplicate, remove, splice, insert)
_TEXT: tuple[Mutator, ...] = (replace_number, change_lines, change_encoding)
_TABLE = (change_cells, change_cells, change_cells, replace_number, change_lines, change_encoding)
_BY_SUFFIX: dict[str, tuple[Mutator, ...]] = {
    "npz": (change_zip, change_members, change_npy_header, change_array, change_array),
    "json": (change_json, change_json, change_json, nest_json, *_TEXT),
    "yaml": (change_yaml, change_yaml, change_yaml, add_yaml, add_yaml, *_TEXT),
    "csv": _TABLE,
    "xz": (*(within_xz(each) for each in _TABLE), bomb_xz),
    "txt": _TEXT,
    "tum": _TEXT,
    "ply": (change_ply_header, change_ply_header, replace_number, change_lines),
    "obj": (change_mesh_text, change_mesh_text, *_TEXT),
    "safetensors": (change_safetensors,),
    "osf": (change_osf,),
    "pcap": (change_pcap,),
    **dict.fromkeys(("bag", "db3", "mcap"), (change_bag, change_bag, flip, overwrite)),
    "e57": (change_e57,),
    "zip": (change_zip, change_members),
    "glb": (change_glb,),
    "stl": (within(overwrite, 80, 184), replace_number),
    "pcd": (within(replace_number, 0, 200), within(change_lines, 0, 200)),
    "laz": (within(flip, 0, 375), within(overwrite, 0, 375)),
    "parquet": (flip, within(flip, -2000)),
}
