"""Bags as other programs leave them: newer metadata, compressed files, parts of one recording, careless clouds."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError, InputWarning
from cdpipe.core.isolated_reader import size_of
from cdpipe.io.foreign import HowToRead, packed_bags, share_topics
from cdpipe.io.foreign.bag_files import _cloud
from cdpipe.io.foreign.bag_layout import _make_folder
from cdpipe.io.readers import open_session
from tests.cdpipe.io import foreign_files
from tests.cdpipe.io.foreign_files import MADE, RosMessages, drive, said, worst_m, write_bag, write_split_bag

NEVER = {"sec": 9223372036, "nsec": 854775807}
QOS = {
    "history": "keep_last", "depth": 10, "reliability": "best_effort", "durability": "volatile", "deadline": NEVER,
    "lifespan": NEVER, "liveliness": "automatic", "liveliness_lease_duration": NEVER,
    "avoid_ros_namespace_conventions": False,
}  # fmt: skip


def change_metadata(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    from ruamel.yaml import YAML  # noqa: PLC0415 - a requirement of rosbags

    document = YAML(typ="safe").load((folder / "metadata.yaml").read_text())
    change(document["rosbag2_bagfile_information"])
    with (folder / "metadata.yaml").open("w") as file:
        YAML().dump(document, file)
    return folder


def make_jazzy(about: dict[str, Any]) -> None:
    """Change metadata to those of ROS 2 Jazzy."""
    about.update(version=9, ros_distro="jazzy", custom_data=None)
    for each in about["topics_with_message_count"]:
        each["topic_metadata"]["offered_qos_profiles"] = [QOS]


def pack(folder: Path) -> Path:
    """Compress the file of a bag as `--compression-mode file` does."""
    import zstandard  # noqa: PLC0415 - a requirement of rosbags

    (db3,) = folder.glob("*.db3")
    (folder / f"{db3.name}.zstd").write_bytes(zstandard.compress(db3.read_bytes()))
    db3.unlink()
    packed = {"compression_mode": "FILE", "compression_format": "zstd", "relative_file_paths": [f"{db3.name}.zstd"]}
    return change_metadata(folder, lambda about: about.update(packed))


def test_a_bag_of_ros_2_jazzy_is_read(tmp_path: Path) -> None:
    folder = change_metadata(write_bag(tmp_path / "ros2", MADE), make_jazzy)
    assert worst_m(folder) < 1e-3


def test_a_folder_with_an_mcap_of_ros_2_jazzy_is_read(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    (tmp_path / "run").mkdir()
    _make_folder(write_bag(tmp_path / "run_0.mcap", MADE), tmp_path / "run", is_mcap=True)
    assert worst_m(change_metadata(tmp_path / "run", make_jazzy)) < 1e-3


def test_metadata_of_jazzy_lead_nowhere_else(tmp_path: Path) -> None:
    folder = change_metadata(write_bag(tmp_path / "ros2", MADE), make_jazzy)
    change_metadata(folder, lambda about: about.update(relative_file_paths=["../.."]))
    assert "metadata.yaml names ['..'], which is not in the folder: copy it again" in said(folder)


def test_metadata_that_name_themselves_as_a_file_of_the_bag_are_not_written_over(tmp_path: Path) -> None:
    folder = change_metadata(write_bag(tmp_path / "ros2", MADE), make_jazzy)
    change_metadata(folder, lambda about: about.update(relative_file_paths=["metadata.yaml"]))
    before = (folder / "metadata.yaml").read_bytes()
    assert "not a readable bag" in said(folder)
    assert (folder / "metadata.yaml").read_bytes() == before


def write_hot_journal(path: Path, names: Path) -> None:
    """Write a journal of SQLite beside a file, as of a commit to several files that was cut short.

    Whoever opens the file for writing goes back to what was before that commit, and removes the file that it names.
    """
    page, mark, name = 4096, bytes.fromhex("d9d505f920a163d7"), str(names).encode()
    head = mark + struct.pack(">5L", 0, 0, path.stat().st_size // page, 512, page)
    last = struct.pack(">L", (1 << 30) // page + 1) + name + struct.pack(">LL", len(name), sum(name)) + mark
    path.with_name(f"{path.name}-journal").write_bytes(head.ljust(512, b"\0") + last)


@pytest.mark.parametrize("marks", ["?immutable=0&x=", "#", "%3Fa#"])
@pytest.mark.parametrize("is_file", [False, True])
def test_no_name_of_a_file_is_an_option_of_sqlite(tmp_path: Path, marks: str, is_file: bool) -> None:
    folder = write_bag(tmp_path / "ros2", MADE)
    (db3,) = folder.glob("*.db3")
    odd = shutil.copy(db3, folder / f"a{marks}.db3")
    db3.rename(folder / "a")
    change_metadata(folder, lambda about: about.update(relative_file_paths=[odd.name]))
    (victim := tmp_path / "victim").write_text("of the user")
    write_hot_journal(folder / "a", victim)
    there = sorted(folder.iterdir())
    assert worst_m(odd if is_file else folder) < 1e-3
    assert victim.read_text() == "of the user" and sorted(folder.iterdir()) == there


@pytest.mark.parametrize("name", ["run #2", "run?", "100%25"])
def test_a_bag_in_a_folder_of_any_name_is_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    assert worst_m(write_bag(tmp_path / "ros2", MADE).rename(tmp_path / name / "bag")) < 1e-3
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("is_jazzy", [False, True])
def test_a_bag_with_compressed_files_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_jazzy: bool) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = write_bag(tmp_path / "ros2", drive(n_points=8_000))
    assert size_of(folder) > 1 << 20  # what the process of rosbags may write
    pack(folder)
    if is_jazzy:
        change_metadata(folder, make_jazzy)
    assert worst_m(folder) < 1e-3
    assert not list(tmp_path.glob("tunnelcd-*"))


def test_the_topics_of_compressed_bags_are_listed_without_decompressing_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bags = [pack(write_bag(tmp_path / name, MADE, "tf", (f"/{name}/points",))) for name in "ab"]
    monkeypatch.setattr(packed_bags, "_write_files", lambda *_: pytest.fail("decompressed"))
    found = share_topics(bags, [HowToRead(topics=("/a/points", "/b/points"))] * 2)
    assert [how.topics for how in found] == [("/a/points",), ("/b/points",)]
    change_metadata(bags[0], lambda about: about.pop("topics_with_message_count"))
    with pytest.raises(InputError, match="a: not a readable bag: 'topics_with_message_count'"):
        share_topics(bags, [HowToRead(topics=("/a/points",))] * 2)


def test_compressed_files_fill_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    folder = pack(write_bag(tmp_path / "ros2", MADE))
    monkeypatch.setattr(packed_bags.shutil, "disk_usage", lambda _: SimpleNamespace(free=200_000))
    text = said(folder)
    assert "ros2: its files take more than 0.0 GB when decompressed, half of what is free in" in text
    assert not list(tmp_path.glob("tunnelcd-*"))
    (file,) = folder.glob("*.zstd")
    file.write_bytes(b"x" * 100)
    assert "not a readable bag" in said(folder)
    change_metadata(folder, lambda about: about.update(compression_format="fake_comp"))
    assert "Compression format 'fake_comp' is not supported" in said(folder)


def test_a_compressed_file_beside_a_bag_is_not_its_own(tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "ros2", MADE)
    (folder / "old_0.db3.zstd").write_bytes(b"x")
    assert worst_m(folder) < 1e-3


@pytest.mark.parametrize("form", ["run_{}.bag", "run_2024-05-31-12-3{}-59_{}.bag", "2024-05-31-12-3{}-59_{}.bag"])
def test_parts_of_a_ros_1_recording_are_read_as_one(tmp_path: Path, form: str) -> None:
    names = [form.format(number, number) for number in (9, 10)] if form == "run_{}.bag" else []
    names = names or [form.format(number, number) for number in (0, 1, 2)]
    assert worst_m(write_split_bag(tmp_path / "run", MADE, names)) < 1e-3


def test_bags_that_are_no_parts_of_one_recording_are_not_joined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for names in (("monday.bag", "friday.bag"), ("a_0.bag", "b_1.bag"), ("run_0.bag", "run_2.bag")):
        text = said(write_split_bag(tmp_path / names[0], MADE, names))
        assert "2 bags: expected the parts of one recording, run_0.bag, run_1.bag and so on: name one of them" in text
    folder = write_split_bag(tmp_path / "later", MADE, ("run_0.bag",))
    monkeypatch.setattr(foreign_files, "START_NS", foreign_files.START_NS + 3600 * 10**9)
    write_bag(folder / "run_1.bag", MADE)
    assert "run_1.bag begins 359" in said(folder)
    assert "s after the end of run_0.bag: expected parts of one recording" in said(folder)


def test_files_of_ros_2_without_metadata_name_the_way_out(tmp_path: Path) -> None:
    (db3,) = write_bag(tmp_path / "ros2", MADE).glob("*.db3")
    shutil.copy(db3, db3.with_name("ros2_1.db3"))
    (tmp_path / "ros2" / "metadata.yaml").unlink()
    assert "2 files without a metadata.yaml: write it by `ros2 bag reindex FOLDER`" in said(tmp_path / "ros2")


def test_an_mcap_of_ros_1_messages_is_named(tmp_path: Path) -> None:
    writer = pytest.importorskip("mcap.writer").Writer(str(tmp_path / "a.mcap"))
    writer.start(profile="ros1", library="test")
    writer.finish()
    assert "an MCAP of ROS 1 messages, which is not read: give the .bag that it was made of" in said(
        tmp_path / "a.mcap"
    )


def first_cloud(**changes: Any) -> Any:
    cloud = next(iter(RosMessages(MADE).clouds()))[1]
    for name, value in changes.items():
        setattr(cloud, name, value)
    return cloud


def test_a_row_step_that_nothing_asks_for_may_be_wrong() -> None:
    points = MADE.clouds[0][0]
    for step in (0, 1, 7 * len(points)):
        np.testing.assert_allclose(_cloud(first_cloud(row_step=step))["points"], points, atol=1e-5)
        found = _cloud(first_cloud(height=2, width=len(points) // 2, row_step=step))
        np.testing.assert_allclose(found["points"], points, atol=1e-5)
    with pytest.raises(ValueError, match="holds"):
        _cloud(first_cloud(height=2, width=len(points), row_step=1))


def test_a_cloud_without_points_needs_no_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = {"height": 0, "width": 0, "fields": [], "point_step": 0, "row_step": 0, "data": np.zeros(0, np.uint8)}
    assert _cloud(first_cloud(**empty))["points"].shape == (0, 3)
    clouds = RosMessages.clouds

    def with_empty(self: RosMessages, frame: str = "os_lidar") -> Any:
        for number, (stamp_s, cloud) in enumerate(clouds(self, frame)):
            for name, value in empty.items() if number == 2 else ():
                setattr(cloud, name, value)
            yield stamp_s, cloud

    monkeypatch.setattr(RosMessages, "clouds", with_empty)
    path = write_bag(tmp_path / "a.bag", MADE)
    with pytest.warns(InputWarning, match="1 of 6 clouds hold no return, and are left out"):
        assert len(list(open_session(path).scans())) == 5
