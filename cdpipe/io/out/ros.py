"""ROS messages of a session, by the package rosbags (extra `formats`): clouds, transforms, the clock. No ROS needed."""

# ruff: noqa: PLC0415 - rosbags is an extra, and everybody else must be able to import this

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cdpipe.core.geometry import Float64Array
from cdpipe.io.out.scans import OutScan

ODOM, SENSOR = "odom", "lidar"
"""Frames of the poses and of the clouds."""
CLOUD, TRANSFORMS, CLOCK = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock"
# Numbers of sensor_msgs/PointField.
_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class RosMessages:
    """Makes messages of ROS 1 or ROS 2."""

    def __init__(self, is_first: bool) -> None:
        """Load the definitions of ROS 1 (Noetic) or ROS 2 (Humble)."""
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.is_first = is_first
        self.store = get_typestore(Stores.ROS1_NOETIC if is_first else Stores.ROS2_HUMBLE)
        if TRANSFORMS not in self.store.types:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))

    def serialize(self, kind: str, message: Any) -> bytes:
        """Return the bytes of a message."""
        of_first, of_second = self.store.serialize_ros1, self.store.serialize_cdr
        return bytes((of_first if self.is_first else of_second)(message, kind))

    def cloud(self, scan: OutScan) -> Any:
        """Return a PointCloud2 of x, y, z, t (uint32 ns after the stamp) and the scalars of a scan."""
        columns = dict(zip("xyz", scan.points.T.astype("<f4"), strict=True))
        if scan.offset_ns is not None and scan.offset_ns.min(initial=0) >= 0:
            columns["t"] = scan.offset_ns.astype("<u4")
        columns |= {name: values.astype(values.dtype.newbyteorder("<")) for name, values in scan.scalars.items()}
        table = np.empty(len(scan.points), np.dtype([(name, values.dtype) for name, values in columns.items()]))
        for name, values in columns.items():
            table[name] = values
        make = self.store.types["sensor_msgs/msg/PointField"]
        fields = [
            make(name=name, offset=place[1], datatype=_DATATYPES[place[0].str[1:]], count=1)
            for name, place in (table.dtype.fields or {}).items()
        ]
        step = table.dtype.itemsize
        return self.store.types[CLOUD](
            header=self._header(scan.stamp_ns, SENSOR), height=1, width=len(table), fields=fields, is_bigendian=False,
            point_step=step, row_step=step * len(table), data=table.view(np.uint8).reshape(-1), is_dense=True,
        )  # fmt: skip

    def transform(self, stamp_ns: int, odom_T_sensor: Float64Array) -> Any:
        """Return the pose (4, 4) of the sensor in odom as a TFMessage."""
        types = self.store.types
        place = types["geometry_msgs/msg/Vector3"](*map(float, odom_T_sensor[:3, 3]))
        quaternion = Rotation.from_matrix(odom_T_sensor[:3, :3]).as_quat()
        turn = types["geometry_msgs/msg/Quaternion"](*map(float, quaternion))
        moved = types["geometry_msgs/msg/Transform"](translation=place, rotation=turn)
        stamped = types["geometry_msgs/msg/TransformStamped"](
            header=self._header(stamp_ns, ODOM), child_frame_id=SENSOR, transform=moved
        )
        return types[TRANSFORMS](transforms=[stamped])

    def clock(self, stamp_ns: int) -> Any:
        """Return a message of the simulated clock."""
        return self.store.types[CLOCK](clock=self._time(stamp_ns))

    def _header(self, stamp_ns: int, frame: str) -> Any:
        more = {"seq": 0} if self.is_first else {}
        return self.store.types["std_msgs/msg/Header"](stamp=self._time(stamp_ns), frame_id=frame, **more)

    def _time(self, stamp_ns: int) -> Any:
        seconds, rest = divmod(int(stamp_ns), 1_000_000_000)
        return self.store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
