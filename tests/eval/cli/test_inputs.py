"""Recordings of other formats at the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pypcd4", reason="pip install 'tunnelcd[formats]'")
pytest.importorskip("rosbags", reason="pip install 'tunnelcd[formats]'")

from cdpipe.core.errors import InputError
from cdpipe.io.foreign import HowToRead, share_topics
from cdpipe.io.readers import open_session
from eval.cli.inputs import how_to_read, open_inputs, read_metres
from eval.core.terminal.progress import Silent
from tests.cdpipe.io.foreign_files import drive, write_bag, write_pcds, write_trajectory
from tests.eval.cli.test_converting import Command, refused


def test_a_bag_becomes_a_session_and_nothing_is_left_of_a_refusal(tmp_path: Path, command: Command) -> None:
    made = drive(12, 200)
    bag = write_bag(tmp_path / "a.bag", made)
    code, out, _ = command("convert", bag, tmp_path / "s")
    assert code == 0
    assert f"12 scans as PLY, trajectory.tum, poses: tf of {bag}" in out
    assert len(list(open_session(tmp_path / "s").scans())) == 12
    refused(command("convert", bag, tmp_path / "s"), "s: is not empty")
    bare = write_bag(tmp_path / "bare.bag", made, "none")
    refused(command("convert", bare, tmp_path / "t"), "no poses of the sensor in it")
    refused(command("convert", bag, tmp_path / "t", "--topic", "/x"), "--topic /x: not in it")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.bag", "bare.bag", "s"]


def test_what_detect_says_of_recordings_and_their_options(tmp_path: Path, command: Command) -> None:
    made = drive(3, 60)
    bag, folder = write_bag(tmp_path / "a.bag", made), write_pcds(tmp_path / "run", made)
    poses, out = write_trajectory(tmp_path / "t.tum", made.stamps_s), ("--out", tmp_path / "out")
    refused(command("detect", bag, tmp_path / "friday", *out), "friday: no such file or folder")
    refused(command("detect", bag, folder, *out), "run: expected exactly one trajectory")
    refused(command("detect", bag, folder, "--trajectory", poses, *out), "--trajectory: given 1 times for 2 recordings")
    mixed = ("--odometry", "kiss-icp", "--trajectory", poses)
    refused(
        command("detect", bag, folder, *mixed, *out),
        "- for one that has its own poses, or whose poses --odometry estimates",
    )
    refused(command("detect", bag, bag, "--odometry", "slam", *out), "--odometry slam: expected kiss-icp")
    refused(command("detect", bag, bag, "--odometry", poses, *out), "kiss-icp or genz-icp (a file: --trajectory)")
    one = ("--trajectory", poses, "--odometry")
    refused(command("describe", folder, *one, "nonsense"), "--odometry nonsense: expected kiss-icp")
    refused(command("describe", folder, *one, "kiss-icp"), "--trajectory and --odometry both give the poses")
    both = ("--trajectory", "-", *one)
    (tmp_path / "ours").mkdir()
    (tmp_path / "ours" / "session.json").write_text("{}")
    refused(command("detect", tmp_path / "ours", folder, *both, "kiss-icp", *out), "--odometry: no recording needs it")
    refused(command("detect", folder, folder, *both[:4], "--topic", "/x", *out), "run is no bag: leave it out")
    sensors = ("--metadata", "-", "--metadata", "m.json")
    refused(command("detect", bag, folder, *sensors, *out), "run: --metadata is the sensor of a .pcap")
    refused(command("view", tmp_path / "ours", "--trajectory", poses, "--html", tmp_path / "v.html"), "its own poses")
    refused(command("view", "smoke/one_box", "--no-deskew", "--html", tmp_path / "v.html"), "a world has no recording")
    refused(command("describe", bag, "--format", "pdf"), "--format pdf: expected one of session")
    refused(
        command("view", tmp_path / "ours", "--origin", "1,2,3", "--html", tmp_path / "v.html"), "leave --origin out"
    )
    refused(command("describe", tmp_path / "ours", "--format", "session"), "session.json: ")  # read as one, and damaged
    refused(command("graft", folder, "--topic", "/x", *out), "run is no bag: leave it out")
    refused(command("graft", bag, "--metadata", "m.json", *out), "--metadata is the sensor of a .pcap: leave it out")
    assert not (tmp_path / "out").exists()


def test_a_grid_of_a_world_is_refused_by_its_own_name(tmp_path: Path, command: Command) -> None:
    out = ("--out", tmp_path / "out")
    refused(
        command("run", "smoke", "--grid", "sensor.mode=512x10,1024x10", *out), "--grid sensor.mode=512x10,1024x10: a"
    )
    refused(command("run", "smoke", "--set", "sensor.mode=512x10", *out), "--set sensor.mode=512x10: a setting of the")


def test_a_wrong_name_makes_no_folder(tmp_path: Path, command: Command) -> None:
    refused(command("survey", "nosuch", "--out", tmp_path / "new" / "x.csv"), "nosuch")
    refused(
        command("bench", "--only", "nosuch", "--out", tmp_path / "new" / "x.json"), "'nosuch' is no row of the table"
    )
    assert not any(tmp_path.iterdir())


def test_the_same_bag_twice_is_said(tmp_path: Path, command: Command) -> None:
    bag = write_bag(tmp_path / "a.bag", drive(3, 900))
    _, _, err = command("detect", bag, bag, "--out", tmp_path / "out")
    assert "one and the same recording" in err


def test_two_bags_may_name_their_clouds_differently(tmp_path: Path, command: Command) -> None:
    made, shared = drive(3, 60), "/spare/points"
    paths = [write_bag(tmp_path / f"{name}.bag", made, "tf", (f"/{name}/points", shared)) for name in "ab"]

    def topics_of(*named: str) -> list[str]:
        hows = how_to_read(2, None, [*named], None, None, None, deskew=True)
        return [how.topics[0] for how in share_topics(paths, hows)]

    assert topics_of("/a/points", "/b/points") == topics_of("/b/points", "/a/points") == ["/a/points", "/b/points"]
    assert topics_of(shared) == [shared, shared]
    # what one of them alone holds is asked of the other, too, which is refused: it has another cloud
    assert topics_of("/a/points") == ["/a/points", "/a/points"]
    both = ("--topic", "/a/points", "--topic", "/b/points", "--out", tmp_path / "out")
    _, _, err = command("detect", *paths, *both)
    told = [line for line in err.splitlines() if "keeps it" not in line]  # those notes repeat the option
    assert "--topic" not in "".join(told) and "topics of PointCloud2" not in err
    refused(command("detect", *paths, "--topic", "/c", *both), "a.bag: --topic /c: not in it")


def test_descriptors_of_other_options_are_stored_apart(tmp_path: Path, command: Command) -> None:
    made = drive(3, 900)
    folder = write_pcds(tmp_path / "run", made)
    write_trajectory(folder / "t.tum", made.stamps_s)
    for more in ((), ("--no-deskew",)):
        assert command("describe", folder, "--preset", "paper", *more)[0] == 0
    default, other = sorted(folder.rglob("*.npz"), key=lambda file: len(file.parts))
    assert default.parent.parent == folder
    assert other.parent.parent.parent == folder
    assert default.read_bytes() != other.read_bytes()


@pytest.mark.parametrize("text", ["1,2", "nan,0,0", "1e400,0,0", "0,0,1.1e8", "a,b,c"])
def test_an_origin_is_three_metres_within_what_poses_may_have(text: str) -> None:
    assert read_metres("origin", "432010.5,-5.4e6,320") == (432010.5, -5.4e6, 320.0)
    with pytest.raises(InputError, match=rf"^--origin {text}: expected three numbers in metres"):
        read_metres("origin", text)


def test_the_command_that_keeps_a_recording_has_the_options_of_its_reading(tmp_path: Path) -> None:
    made = drive()
    bag = write_bag(tmp_path / "a.mcap", made)
    how = HowToRead(
        trajectory=write_trajectory(tmp_path / "t.tum", made.stamps_s), topics=("/ouster/points",), deskew=False
    )

    told: list[str] = []

    class Notes(Silent):
        def note(self, text: str) -> None:
            told.append(text)

    open_inputs([bag], [how], Notes())
    command = f"tunnelcd convert {bag} FOLDER --trajectory {tmp_path / 't.tum'} --topic /ouster/points --no-deskew"
    assert told == [f"{bag} was read into a temporary folder: `{command}` keeps it"]
