"""Recordings in other people's formats, written by other people's libraries from the scans of a source."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cdpipe.core.errors import InputError
from cdpipe.core.geometry import Float64Array, invert, make_pose, transform, yaw_pose
from cdpipe.io.foreign import HowToRead
from cdpipe.io.readers import open_session

START_NS = 1_700_000_000_000_000_000
BASE_HZ = 50.0
IMU_POSE = make_pose(np.eye(3), (0.006, -0.012, 0.008))
BASE_T_SENSOR = make_pose(Rotation.from_euler("xyz", (0.0, 5.0, 90.0), degrees=True).as_matrix(), (0.3, 0.1, 0.8))


@dataclass(frozen=True)
class Drive:
    """A sensor in a box: scans whose points are taken while it moves, 10 Hz.

    Attributes:
        stamps_s: (S,) times of the scans, counted from START_NS.
        clouds: For each scan its points, each in the sensor frame at its own time, and that time after the stamp.
    """

    stamps_s: Float64Array
    clouds: Sequence[tuple[Float64Array, Float64Array]]

    def pose(self, time_s: float | Float64Array) -> Float64Array:
        return odom_T_sensor(np.asarray(time_s))


def odom_T_sensor(time_s: Any) -> Float64Array:
    """Return poses (..., 4, 4): 1.5 m/s along a bend of 0.5 rad/s."""
    turns = Rotation.from_euler("ZYX", np.stack([0.5 * time_s, 0.05 * np.sin(time_s), 0 * time_s], -1).reshape(-1, 3))
    at = np.stack([1.5 * time_s, 0.2 * time_s**2, 0.1 + 0 * time_s], -1)
    return make_pose(turns.as_matrix().reshape(*np.shape(time_s), 3, 3), at)


def drive(n_scans: int = 6, n_points: int = 900, sweep_s: float = 0.1) -> Drive:
    """Return scans of the walls of a box of 24 x 16 x 6 m; with `sweep_s` 0 all points are taken at the stamp."""
    rng = np.random.default_rng(5)
    stamps_s = 0.5 + 0.1 * np.arange(n_scans)
    clouds = []
    for stamp_s in stamps_s:
        offset_s = np.sort(rng.uniform(0.0, sweep_s, n_points)) if sweep_s else np.zeros(n_points)
        offset_s[:1], offset_s[-1:] = 0.0, sweep_s
        walls = rng.uniform(-1.0, 1.0, (n_points, 3))
        axis = rng.integers(0, 3, n_points)
        walls[np.arange(n_points), axis] = np.sign(walls[np.arange(n_points), axis])
        walls = walls * (12.0, 8.0, 3.0)
        sensor_T_odom = invert(odom_T_sensor(stamp_s + offset_s))
        points = np.einsum("nij,nj->ni", sensor_T_odom[:, :3, :3], walls) + sensor_T_odom[:, :3, 3]
        clouds.append((points, offset_s))
    return Drive(stamps_s, clouds)


def off_walls_m(points_odom: Float64Array) -> Float64Array:
    """Return the distance (N,) of points from the nearest wall of the box."""
    return np.abs(np.abs(points_odom) - (12.0, 8.0, 3.0)).min(axis=1)


def write_trajectory(path: Path, time_s: Float64Array, kind: str = "tum", order: str = "xyzw") -> Path:
    """Write poses of the drive at times, as TUM, KITTI, or CSV with a header."""
    poses = odom_T_sensor(time_s)
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    if order == "wxyz":
        turns = np.roll(turns, 1, axis=1)
    stamps = START_NS / 1e9 + time_s
    if kind == "tum":
        rows = [[f"{stamp:.6f}", *row] for stamp, row in zip(stamps, _text(poses[:, :3, 3], turns), strict=True)]
        path.write_text("".join(" ".join(row) + "\n" for row in rows))
    elif kind == "kitti":
        path.write_text("".join(" ".join(row) + "\n" for row in _text(poses[:, :3].reshape(-1, 12))))
    else:
        rows = [
            [f"{int(stamp * 1e6)}000", *row] for stamp, row in zip(stamps, _text(poses[:, :3, 3], turns), strict=True)
        ]
        names = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_x [],q_RS_y [],q_RS_z [],q_RS_w []"
        path.write_text(names + "\n" + "".join(",".join(row) + "\n" for row in rows))
    return path


def _text(*parts: Float64Array) -> list[list[str]]:
    return [[f"{number:.9g}" for number in row] for row in np.concatenate(parts, axis=1)]


def write_pcds(folder: Path, made: Drive, encoding: str = "binary", *, with_time: bool = True) -> Path:
    """Write scans with pypcd4; the times are float32 seconds after the stamp, as Velodyne's driver has them."""
    from pypcd4 import Encoding, PointCloud  # noqa: PLC0415 - only where the extra is installed

    folder.mkdir(parents=True, exist_ok=True)
    for index, (points, offset_s) in enumerate(made.clouds):
        names = ("x", "y", "z", "intensity", "time") if with_time else ("x", "y", "z", "intensity")
        columns = np.column_stack([points, np.full(len(points), 7.0), offset_s])[:, : len(names)].astype(np.float32)
        cloud = PointCloud.from_points(columns, names, (np.float32,) * len(names))
        cloud.save(folder / f"{index:06d}.pcd", Encoding(encoding))
    return folder


def write_lases(folder: Path, made: Drive, suffix: str = ".laz") -> Path:
    """Write scans with laspy; the times are GPS seconds of the scans' clock."""
    import laspy  # noqa: PLC0415

    folder.mkdir(parents=True, exist_ok=True)
    for index, (points, offset_s) in enumerate(made.clouds):
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
        data = laspy.LasData(header)
        data.x, data.y, data.z = points.T
        data.gps_time = START_NS / 1e9 + made.stamps_s[index] + offset_s
        data.write(folder / f"{index:06d}{suffix}")
    return folder


def write_copc(path: Path, points: Float64Array) -> Path:
    """Write a COPC file by hand, as laspy writes none: a node for all, and one for the eighth below the middle."""
    import laspy  # noqa: PLC0415
    import lazrs  # noqa: PLC0415
    from laspy.vlrs.known import LasZipVlr  # noqa: PLC0415

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
    header.mins, header.maxs = points.min(axis=0), points.max(axis=0)
    header.point_count, header.are_points_compressed = len(points), True
    laz = lazrs.LazVlr.new_for_compression(6, 0, use_variable_size_chunks=True)
    header.vlrs.extend([laspy.VLR("copc", 1, "", bytes(160)), LasZipVlr(laz.record_data())])
    middle = points.mean(axis=0)
    is_below = (points < middle).all(axis=1)
    with path.open("wb+") as file:
        header.write_to(file)
        compressor = lazrs.LasZipCompressor(file, laz)
        for number, part in enumerate((points[~is_below], points[is_below])):
            record = laspy.ScaleAwarePointRecord.zeros(len(part), header=header)
            record.x, record.y, record.z = part.T
            if number:
                compressor.finish_current_chunk()
            compressor.compress_many(np.frombuffer(record.array, np.uint8))
        compressor.done()
        file.seek(header.offset_to_point_data)
        page, at = b"", header.offset_to_point_data + 8
        for level, (n_points, n_bytes) in enumerate(lazrs.read_chunk_table(file, laz)):
            page += struct.pack("<4iQ2i", level, 0, 0, 0, at, n_bytes, n_points)
            at += n_bytes
        header.start_of_first_evlr, header.number_of_evlrs = file.seek(0, os.SEEK_END), 1
        file.write(struct.pack("<H16sHQ32s", 0, b"copc", 1000, len(page), b"") + page)
        info = *middle, float(np.abs(points - middle).max()), 1.0, header.start_of_first_evlr + 60, len(page), 0.0, 0.0
        header.vlrs[0].record_data = struct.pack("<5d2Q2d88x", *info)
        file.seek(0)
        header.write_to(file, ensure_same_size=True)
    return path


def write_kitti(folder: Path, made: Drive) -> Path:
    """Write scans in the layout of SemanticKITTI: poses of a camera, and calib.txt with the lidar's place on it."""
    (folder / "velodyne").mkdir(parents=True)
    for index, (points, _) in enumerate(made.clouds):
        np.column_stack([points, np.zeros(len(points))]).astype(np.float32).tofile(
            folder / "velodyne" / f"{index:06d}.bin"
        )
    camera_T_sensor = make_pose(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), (0.1, -0.2, -0.3))
    world_T_camera = camera_T_sensor @ odom_T_sensor(made.stamps_s) @ invert(camera_T_sensor)
    np.savetxt(folder / "poses.txt", world_T_camera[:, :3].reshape(-1, 12), fmt="%.9e")
    rows = " ".join(f"{number:.12e}" for number in camera_T_sensor[:3].ravel())
    (folder / "calib.txt").write_text(f"P0: {' '.join(['0'] * 12)}\nTr: {rows}\n")
    np.savetxt(folder / "times.txt", made.stamps_s, fmt="%.6e")
    return folder


def write_e57(path: Path, made: Drive) -> Path:
    """Write scans with pye57, each with the pose of its scanner."""
    import pye57  # noqa: PLC0415

    with pye57.E57(str(path), mode="w") as file:
        for stamp_s, (points, _) in zip(made.stamps_s, made.clouds, strict=True):
            pose = odom_T_sensor(stamp_s)
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            data = {f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}
            file.write_scan_raw(data, rotation=np.array([w, x, y, z]), translation=pose[:3, 3].copy())
    return path


def write_merged_e57(path: Path, points: Float64Array) -> Path:
    """Write one cloud without a pose, as software that merges the stations of a survey does."""
    import pye57  # noqa: PLC0415

    bounds = {f"{axis}{end}imum": each for end, row in (("Min", points.min(axis=0)), ("Max", points.max(axis=0)))
              for axis, each in zip("xyz", row, strict=True)}  # fmt: skip
    head = SimpleNamespace(rotation=None, translation=None, **bounds)
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw({f"cartesian{axis}": points[:, k].copy() for k, axis in enumerate("XYZ")}, scan_header=head)
    return path


class RosMessages:
    """The drive as ROS messages: clouds, and the poses of a base with a fixed mounting of the sensor."""

    def __init__(self, made: Drive, store: str = "ROS2_HUMBLE") -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore  # noqa: PLC0415

        self.store = get_typestore(getattr(Stores, store))
        if "tf2_msgs/msg/TFMessage" not in self.store.types:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.types, self.is_first = self.store.types, store.startswith("ROS1")
        self._made = made

    def _header(self, time_s: float, frame: str) -> Any:
        ns = START_NS + round(time_s * 1e9)
        stamp = self.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        more = {"seq": 0} if self.is_first else {}
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **more)

    def clouds(self, frame: str = "os_lidar") -> Iterable[tuple[float, Any]]:
        """Yield stamps and clouds: x, y, z as float32, padding, and t as Ouster's driver has it (uint32 ns).

        In frame "odom" the clouds are registered.
        """
        dtype = np.dtype({"names": ["x", "y", "z", "t"], "formats": ["<f4", "<f4", "<f4", "<u4"],
                          "offsets": [0, 4, 8, 20], "itemsize": 32})  # fmt: skip
        field = self.types["sensor_msgs/msg/PointField"]
        fields = [field(name=n, offset=o, datatype=k, count=1) for n, o, k in
                  (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("t", 20, 6))]  # fmt: skip
        for stamp_s, (points, offset_s) in zip(self._made.stamps_s, self._made.clouds, strict=True):
            table = np.zeros(len(points), dtype)
            poses = odom_T_sensor(stamp_s + offset_s) if frame == "odom" else np.eye(4)[None]
            moved = (poses[:, :3, :3] @ points[..., None])[..., 0] + poses[:, :3, 3]
            for axis, values in zip("xyz", moved.T, strict=True):
                table[axis] = values
            table["t"] = np.round(offset_s * 1e9)
            yield stamp_s, self.types["sensor_msgs/msg/PointCloud2"](
                header=self._header(stamp_s, frame), height=1, width=len(points), fields=fields,
                is_bigendian=False, point_step=32, row_step=32 * len(points),
                data=np.frombuffer(table.tobytes(), np.uint8), is_dense=True,
            )  # fmt: skip

    def _parts(self, pose: Float64Array) -> tuple[Any, Any]:
        turn = self.types["geometry_msgs/msg/Quaternion"](*map(float, Rotation.from_matrix(pose[:3, :3]).as_quat()))
        return [float(n) for n in pose[:3, 3]], turn

    def transform(self, time_s: float, parent: str, child: str, pose: Float64Array) -> Any:
        at, turn = self._parts(pose)
        moved = self.types["geometry_msgs/msg/Transform"](
            translation=self.types["geometry_msgs/msg/Vector3"](*at), rotation=turn
        )
        stamped = self.types["geometry_msgs/msg/TransformStamped"](
            header=self._header(time_s, parent), child_frame_id=child, transform=moved
        )
        return self.types["tf2_msgs/msg/TFMessage"](transforms=[stamped])

    def odometry(self, time_s: float, pose: Float64Array, child: str = "base_link") -> Any:
        at, turn = self._parts(pose)
        here = self.types["geometry_msgs/msg/Pose"](
            position=self.types["geometry_msgs/msg/Point"](*at), orientation=turn
        )
        zero = self.types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        twist = self.types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
        return self.types["nav_msgs/msg/Odometry"](
            header=self._header(time_s, "odom"), child_frame_id=child,
            pose=self.types["geometry_msgs/msg/PoseWithCovariance"](pose=here, covariance=np.zeros(36)),
            twist=self.types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def pose(self, time_s: float, pose: Float64Array) -> Any:
        at, turn = self._parts(pose)
        here = self.types["geometry_msgs/msg/Pose"](
            position=self.types["geometry_msgs/msg/Point"](*at), orientation=turn
        )
        return self.types["geometry_msgs/msg/PoseStamped"](header=self._header(time_s, "map"), pose=here)

    def all(self, poses: str, cloud_topics: Sequence[str], last_pose_s: float) -> list[tuple[str, str, float, Any]]:
        """Return topic, type, time and message of everything: `poses` is tf, odometry, pose or none.

        With "footprint" there is odometry, and tf moves between two frames of the robot; with "standing" tf repeats
        that the robot stands in the map; with "registered" the clouds lie in the frame of the odometry. "mounting" has
        no poses, and tf that repeats where the sensor is on the robot. "imu" has odometry of a part beside the sensor,
        "unnamed" poses of the robot that name no frame, "twice" tf that tells the mounting at two times, "wheel" that
        and parts that turn by no rotation, "frames" clouds that say they are of two sensors. With "spin" the sensor
        turns on the robot, with "leg" the robot on its footprint. With "merged" it stands in odom, which moves.
        """
        made = [
            (topic, "sensor_msgs/msg/PointCloud2", time_s, cloud)
            for topic in cloud_topics
            for time_s, cloud in self.clouds("odom" if poses == "registered" else "os_lidar")
        ]
        for *_, cloud in made[1::2] if poses == "frames" else ():
            cloud.header.frame_id = "rear"
        times = np.arange(self._made.stamps_s[0] - 0.1, min(self._made.stamps_s[-1] + 0.25, last_pose_s), 1 / BASE_HZ)
        base = odom_T_sensor(times) @ invert(BASE_T_SENSOR)
        tf, first = "tf2_msgs/msg/TFMessage", float(times[0])
        if poses in ("tf", "odometry", "footprint", "standing", "leg", "merged"):
            made.append(("/tf_static", tf, first, self.transform(first, "base_link", "os_lidar", BASE_T_SENSOR)))
        if poses == "imu":
            turned = yaw_pose(np.pi, (0.0, 0.0, 0.04))
            made.append(("/tf_static", tf, first, self.transform(first, "os_sensor", "os_lidar", turned)))
            made.append(("/tf_static", tf, first, self.transform(first, "os_sensor", "os_imu", IMU_POSE)))
        if poses == "unnamed":
            made.append(("/tf_static", tf, first, self.transform(first, "base_link", "os_lidar", BASE_T_SENSOR)))
        for number, (time_s, pose) in enumerate(zip(times.tolist(), base, strict=True)):
            if poses in ("twice", "wheel"):
                made.append(("/tf", tf, time_s, self.transform(time_s, "odom", "base_link", pose)))
                if number in (10, 12):
                    made.append(("/tf", tf, time_s, self.transform(time_s, "base_link", "os_lidar", BASE_T_SENSOR)))
                for parent, child in (
                    (("base_link", "wheel"), ("odom", "base_link")) if (poses, number) == ("wheel", 5) else ()
                ):
                    wrong = self.transform(time_s + 0.001, parent, child, np.eye(4))
                    wrong.transforms[0].transform.rotation.w = 0.0
                    made.append(("/tf", tf, time_s, wrong))
            elif poses == "imu":
                at = pose @ BASE_T_SENSOR @ invert(yaw_pose(np.pi, (0.0, 0.0, 0.04))) @ IMU_POSE
                made.append(("/odom", "nav_msgs/msg/Odometry", time_s, self.odometry(time_s, at, "os_imu")))
            elif poses == "unnamed":
                made.append(("/slam/pose", "geometry_msgs/msg/PoseStamped", time_s, self.pose(time_s, pose)))
            elif poses == "tf":
                made.append(("/tf", tf, time_s, self.transform(time_s, "odom", "base_link", pose)))
                made.append(
                    ("/tf", tf, time_s, self.transform(time_s, "map", "odom", yaw_pose(0.3, (5.0, time_s, 0.0))))
                )
            elif poses in ("spin", "leg", "merged"):
                parent, child, at = {
                    "spin": ("spin_base", "os_lidar", pose), "leg": ("base_footprint", "base_link", pose),
                    "merged": ("map", "odom", pose),
                }[poses]  # fmt: skip
                made.append(("/tf", tf, time_s, self.transform(time_s, parent, child, at)))
                if poses == "merged":
                    made.append(("/tf", tf, time_s, self.transform(time_s, "odom", "base_link", np.eye(4))))
            elif poses == "mounting":
                made.append(("/tf", tf, time_s, self.transform(time_s, "base_link", "os_lidar", BASE_T_SENSOR)))
            elif poses in ("odometry", "footprint", "standing", "registered"):
                made.append(("/odom", "nav_msgs/msg/Odometry", time_s, self.odometry(time_s, pose)))
                above = {"footprint": "base_footprint", "standing": "map"}.get(poses)
                if above is not None:
                    made.append(("/tf", tf, time_s, self.transform(time_s, above, "base_link", np.eye(4))))
            elif poses == "pose":
                sensor = self.pose(time_s, pose @ BASE_T_SENSOR)
                made.append(("/slam/pose", "geometry_msgs/msg/PoseStamped", time_s, sensor))
        return sorted(made, key=lambda each: each[2])


def write_bag(
    path: Path,
    made: Drive,
    poses: str = "tf",
    cloud_topics: Sequence[str] = ("/ouster/points",),
    last_pose_s: float = np.inf,
    **options: Any,
) -> Path:
    """Write a bag with rosbags: ROS 1 if the name ends in .bag, else ROS 2 with sqlite3; .mcap with package mcap.

    The options are those of the writer of MCAP.
    """
    if path.suffix == ".mcap":
        return _write_mcap(path, made, poses, cloud_topics, last_pose_s, **options)
    messages = RosMessages(made, "ROS1_NOETIC" if path.suffix == ".bag" else "ROS2_HUMBLE")
    return _write_rosbag(path, messages, messages.all(poses, cloud_topics, last_pose_s))


def write_split_bag(folder: Path, made: Drive, names: Sequence[str]) -> Path:
    """Write parts of one ROS 1 recording with odometry, one file after the other, as `rosbag record --split` does."""
    folder.mkdir()
    messages = RosMessages(made, "ROS1_NOETIC")
    rows = messages.all("odometry", ("/ouster/points",), np.inf)
    ends = np.linspace(0, len(rows), len(names) + 1).astype(int)
    for name, start, end in zip(names, ends[:-1], ends[1:], strict=True):
        _write_rosbag(folder / name, messages, rows[start:end])
    return folder


def _write_rosbag(path: Path, messages: RosMessages, rows: Sequence[tuple[str, str, float, Any]]) -> Path:
    from rosbags.rosbag1 import Writer as Writer1  # noqa: PLC0415
    from rosbags.rosbag2 import Writer as Writer2  # noqa: PLC0415

    store, is_first = messages.store, messages.is_first
    with (Writer1 if is_first else Writer2)(path) as bag:
        connections: dict[str, Any] = {}
        for topic, kind, time_s, message in rows:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            raw = store.serialize_ros1(message, kind) if is_first else store.serialize_cdr(message, kind)
            bag.write(connections[topic], START_NS + round(time_s * 1e9), raw)
    return path


def _write_mcap(
    path: Path, made: Drive, poses: str, cloud_topics: Sequence[str], last_pose_s: float, **options: Any
) -> Path:
    from mcap.writer import Writer  # noqa: PLC0415

    messages = RosMessages(made)
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2", library="test")
        channels: dict[str, int] = {}
        for topic, kind, time_s, message in messages.all(poses, cloud_topics, last_pose_s):
            if topic not in channels:
                text = messages.store.generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            ns = START_NS + round(time_s * 1e9)
            writer.add_message(channels[topic], ns, bytes(messages.store.serialize_cdr(message, kind)), ns)
        writer.finish()
    return path


MADE, STANDING = drive(), drive(sweep_s=0.0)


def worst_m(path: Path, how: HowToRead | None = None) -> float:
    """Return the largest distance of a return from the walls."""
    source = open_session(path, how)
    scans = list(source.scans())
    assert len(scans) == len(MADE.stamps_s) == len(source.odom_T_sensor)
    np.testing.assert_allclose(source.odom_T_sensor, odom_T_sensor(MADE.stamps_s), atol=1e-4)
    return max(float(off_walls_m(transform(scan.odom_T_sensor, scan.points_sensor)).max()) for scan in scans)


def said(path: Path, how: HowToRead | None = None) -> str:
    with pytest.raises(InputError) as caught:
        list(open_session(path, how).scans())
    assert "\n" not in str(caught.value)
    return str(caught.value)
