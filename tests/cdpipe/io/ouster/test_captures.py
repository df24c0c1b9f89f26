"""Recordings that are damaged, foreign or of two files: what is read, and what is said."""

from __future__ import annotations

import json
import os
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cdpipe.core.errors import InputError
from cdpipe.io.ouster import integrity
from cdpipe.io.ouster.captures import open_recording
from cdpipe.io.ouster.osf import write_osf
from cdpipe.io.ouster.recording import import_recording
from cdpipe.io.session import read_session
from cdpipe.sensor.ouster import load_profile
from tests.cdpipe.recordings import (
    SENSOR,
    START_NS,
    frames,
    info_of,
    left,
    osf,
    record,
    said,
    write_frames,
    write_tum,
)


def test_damaged_and_foreign_osf_files_are_named(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    whole = write_frames(tmp_path / "whole.osf", info, frames(info)).read_bytes()
    path = tmp_path / "cut.osf"
    for n_bytes, expected in (
        (0, "not an OSF file"),
        (20, "never finished|cut short|not an OSF"),
        (len(whole) // 2, "cut short: .* bytes are there"),
        (len(whole) - 1, "cut short"),
    ):
        path.write_bytes(whole[:n_bytes])
        with pytest.raises(InputError, match=expected):
            import_recording(path, tmp_path / "s")
    path.write_bytes(b"PNG" * 1000)
    assert "not an OSF file" in said(lambda: import_recording(path, tmp_path / "s"))
    hole = len(whole) // 2
    path.write_bytes(whole[:hole] + bytes(2000) + whole[hole + 2000 :])
    assert "damaged: " in said(lambda: import_recording(path, tmp_path / "s"))
    assert left(tmp_path) == ["cut.osf", "whole.osf"]


def test_an_osf_whose_header_or_metadata_were_damaged_is_named(tmp_path: Path) -> None:
    """The SDK follows lengths and offsets in both wherever they lead, which ends the process."""
    info = info_of(SENSOR)
    whole = write_frames(tmp_path / "whole.osf", info, frames(info)).read_bytes()
    metadata_at = struct.unpack_from("<Q", whole, 40)[0]
    path = tmp_path / "bad.osf"
    for at, part in (
        (0, "header"), (2, "header"), (3, "header"), (56, "header"),
        (metadata_at, "metadata"), (metadata_at + 3, "metadata"), (metadata_at + 5, "metadata"),
        (metadata_at + 500, "metadata"), (len(whole) - 1, "metadata"),
    ):  # fmt: skip
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        assert f"damaged: its {part} and the checksum of it do not agree" in said(lambda: open_recording(path))
    path.write_bytes(whole + b"x")
    told = said(lambda: open_recording(path))
    assert f"damaged: {len(whole) + 1} bytes where its header says {len(whole)}: copy it again" in told


def test_an_osf_that_crashes_the_sdk_is_one_line(tmp_path: Path) -> None:
    """Changed offsets under correct checksums; the SDK 1.0.1 follows them out of the file (segmentation fault)."""
    info = info_of(SENSOR)
    whole = write_frames(tmp_path / "whole.osf", info, frames(info, 1)).read_bytes()
    path = tmp_path / "bad.osf"
    told = []
    for block, at, new in ((0, 31, "80800001"), (2, 175, "8080807f"), (3, 167, "ff"), (3, 492, "80")):
        path.write_bytes(with_checksum(whole, block, at, bytes.fromhex(new)))
        told.append(said(lambda: list(open_recording(path).revolutions())))
    assert [line for line in told if "the vendor's SDK crashed while it read it (SIG" in line] == told


def with_checksum(osf_bytes: bytes, block: int, at: int, new: bytes) -> bytes:
    """Replace bytes in one of the four blocks of an OSF, and correct its checksum."""
    data, start = bytearray(osf_bytes), 0
    for _ in range(block):
        start += 8 + struct.unpack_from("<I", data, start)[0]
    end = start + 4 + struct.unpack_from("<I", data, start)[0]
    data[start + at : start + at + len(new)] = new
    data[end : end + 4] = struct.pack("<I", zlib.crc32(data[start:end]))
    return bytes(data)


def test_an_osf_whose_header_points_beyond_the_file_is_named(tmp_path: Path) -> None:
    info = info_of(SENSOR)
    whole = write_frames(tmp_path / "whole.osf", info, frames(info, 1)).read_bytes()
    path = tmp_path / "bad.osf"
    for last in ("7f", "ff"):
        path.write_bytes(with_checksum(whole, 0, 47, bytes.fromhex(last)))
        assert "damaged: its metadata" in said(lambda: open_recording(path))


def test_an_osf_of_two_sensors_is_refused(tmp_path: Path) -> None:
    infos = [info_of(replace(SENSOR, serial=serial)) for serial in ("1001", "1002")]
    path = tmp_path / "two.osf"
    with osf.Writer(str(path), infos) as writer:
        for stream, info in enumerate(infos):
            writer.save(stream, frames(info, 1)[0])
    told = said(lambda: import_recording(path, tmp_path / "s"))
    assert "2 (OS-1-32-G 1001, OS-1-32-G 1002)" in told


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    info = info_of(SENSOR)
    return record(tmp_path / "c.pcap", info, frames(info))


def pcapng_of(path: Path) -> Path:
    """The same packets in the newer container: a section, an interface, a block for each packet."""
    data = path.read_bytes()
    blocks, at = [struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)], 24
    blocks.append(struct.pack("<IIHHII", 1, 20, 1, 0, 65535, 20))
    while at < len(data):
        length = struct.unpack_from("<I", data, at + 8)[0]
        body = data[at + 16 : at + 16 + length] + bytes(-length % 4)
        size = 32 + len(body)
        blocks.append(
            struct.pack("<IIIIIII", 6, size, 0, 0, len(blocks), length, length) + body + struct.pack("<I", size)
        )
        at += 16 + length
    out = path.with_suffix(".pcapng")
    out.write_bytes(b"".join(blocks))
    return out


def test_a_pcap_with_its_metadata_comes_in(capture: Path, tmp_path: Path) -> None:
    tum = write_tum(tmp_path / "t.tum", -0.05, 0.4)
    made = frames(info_of(SENSOR))
    for number, source in enumerate((capture, pcapng_of(capture))):
        out = tmp_path / f"s{number}"
        assert import_recording(source, out, trajectory=tum).n_scans == 3
        chunk = read_session(out).chunk(0)
        for row, frame in enumerate(made):
            np.testing.assert_array_equal(chunk.range_mm[row], frame.field("RANGE"))
            np.testing.assert_array_equal(chunk.signal[row], frame.field("SIGNAL"))
            np.testing.assert_array_equal(chunk.column_stamps_ns[row] + START_NS, frame.timestamp)


def test_a_pcap_that_lost_packets_keeps_the_rest(capture: Path, tmp_path: Path) -> None:
    info = info_of(SENSOR)
    made = frames(info)
    for frame in made:
        frame.status[64:96] = 0  # two packets
    path = record(tmp_path / "lost.pcap", info, made)
    import_recording(path, tmp_path / "s", trajectory=write_tum(tmp_path / "t.tum", -0.05, 0.4))
    chunk = read_session(tmp_path / "s").chunk(0)
    assert (chunk.range_mm[:, :, 64:96] == 0).all()
    assert chunk.range_mm[0, :, 96:].any()
    np.testing.assert_allclose(np.diff(chunk.column_stamps_ns[0]), 195_312, atol=2)


@pytest.mark.parametrize("kind", ["pcap", "pcapng"])
def test_a_pcap_that_is_cut_while_it_is_read_is_named(
    capture: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = capture if kind == "pcap" else pcapng_of(capture)
    walk = getattr(integrity, f"_walk_{kind}")

    def cut(*arguments: Any) -> Any:
        os.truncate(source, 4096)
        return walk(*arguments)

    monkeypatch.setattr(integrity, f"_walk_{kind}", cut)
    assert "cut short or damaged after " in said(lambda: open_recording(source))


def test_metadata_of_a_pcap(capture: Path, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere.json"
    capture.with_suffix(".json").rename(moved)
    told = said(lambda: open_recording(capture))
    assert "c.json is not beside it" in told
    assert told.endswith("only Ouster's PCAPs are read: those of other sensors as a bag or as PCD")
    assert len(list(open_recording(capture, moved).revolutions())) == 3
    fewer = tmp_path / "fewer.json"
    fewer.write_text(info_of(load_profile("os1-32-g", "1024x10")).to_json_string())
    assert "no whole revolution" in said(lambda: list(open_recording(capture, fewer).revolutions()))
    wide = load_profile("os1-32-g", "1024x10")
    other = record(tmp_path / "wide.pcap", info_of(wide), frames(info_of(wide), 1))
    assert "1023" in said(lambda: open_recording(other, moved))
    n = 128
    tall = replace(
        SENSOR, product="OS-1-128", altitude_deg=np.linspace(20, -20, n), azimuth_deg=np.zeros(n), pixel_shift=(0,) * n
    )
    fewer.write_text(info_of(tall).to_json_string())
    told = said(lambda: list(open_recording(capture, fewer).revolutions()))
    assert "no lidar packet of the sensor in" in told
    assert "OS-1-128" in told
    fewer.write_text(json.dumps({"lasers": [], "num_lasers": 16}))
    assert "fewer.json: beam_altitude_angles" in said(lambda: open_recording(capture, fewer))
    assert "none.json: " in said(lambda: open_recording(capture, tmp_path / "none.json"))


def test_a_capture_cut_anywhere_is_named(capture: Path, tmp_path: Path) -> None:
    metadata = capture.with_suffix(".json")
    for source in (capture, pcapng_of(capture)):
        whole = source.read_bytes()
        path = tmp_path / f"part{source.suffix}"
        for n_bytes in (0, 10, 25, 400, len(whole) // 2, len(whole) - 1):
            path.write_bytes(whole[:n_bytes])
            told = said(lambda path=path: open_recording(path, metadata))
            assert told.startswith(f"{path}: ")
            assert ("not a PCAP file" if n_bytes < 24 else "cut short or damaged after") in told
        path.write_bytes(b"GIF89a" + bytes(100))
        assert "neither PCAP nor PCAPNG" in said(lambda path=path: open_recording(path, metadata))


def test_a_capture_of_another_link_or_version_is_named(capture: Path) -> None:
    whole = capture.read_bytes()
    for at, byte in ((20, 195), (7, 255), (23, 255), (4, 0)):
        capture.write_bytes(whole[:at] + bytes([byte]) + whole[at + 1 :])
        assert said(lambda: open_recording(capture)).startswith(f"{capture}: the vendor's SDK cannot read it: ")


def test_a_capture_of_another_makers_sensor(tmp_path: Path) -> None:
    """Sixteen-beam packets of 1206 bytes to port 2368, as another maker's sensors send."""
    udp = struct.pack(">HHHH", 2368, 2368, 8 + 1206, 0) + bytes(1206)
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes([192, 168, 1, 2]), bytes(4))
    packet = bytes(12) + b"\x08\x00" + ip + udp
    records = b"".join(struct.pack("<IIII", 1, n, len(packet), len(packet)) + packet for n in range(200))
    path = tmp_path / "other.pcap"
    path.write_bytes(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1) + records)
    path.with_suffix(".json").write_text(info_of(SENSOR).to_json_string())
    told = said(lambda: import_recording(path, tmp_path / "s", odometry=None))
    assert "no lidar packet of the sensor in" in told


def test_names_that_are_no_recording(tmp_path: Path) -> None:
    (tmp_path / "folder.osf").mkdir()
    (tmp_path / "scan.bag").write_bytes(b"x")
    assert "is a folder" in said(lambda: open_recording(tmp_path / "folder.osf"))
    assert "no such file" in said(lambda: open_recording(tmp_path / "none.pcap"))
    assert ".osf, .pcap, .pcapng" in said(lambda: open_recording(tmp_path / "scan.bag"))
    assert "leave --metadata out" in said(lambda: open_recording(_empty(tmp_path / "a.osf"), tmp_path / "m.json"))


def _empty(path: Path) -> Path:
    path.write_bytes(b"")
    return path


def test_without_the_sdk_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = info_of(SENSOR)
    path = write_frames(tmp_path / "a.osf", info, frames(info, 1))
    monkeypatch.setitem(sys.modules, "ouster.sdk", None)
    assert "pip install 'tunnelcd[ouster]'" in said(lambda: write_osf(_none(), path))
    (tmp_path / "without" / "ouster").mkdir(parents=True)
    (tmp_path / "without" / "ouster" / "__init__.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(tmp_path / "without")
    assert "pip install 'tunnelcd[ouster]'" in said(lambda: open_recording(path))


def _none() -> Any:
    return None
