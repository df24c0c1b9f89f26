"""The beam table against the vendor's SDK, on real recordings."""

import os
from pathlib import Path

import numpy as np
import pytest

from cdpipe.sensor.ouster import load_profile

core = pytest.importorskip("ouster.sdk.core", reason="pip install 'tunnelcd[ouster]'")
ROOT = Path(os.environ.get("TUNNELCD_REAL_DATA", "")) / "ouster"
pytestmark = pytest.mark.skipif(
    "TUNNELCD_REAL_DATA" not in os.environ, reason="real recordings: TUNNELCD_REAL_DATA is not set"
)


def test_real_revolution_projects_as_the_vendor_does() -> None:
    pcap = pytest.importorskip("ouster.sdk.pcap")
    name = "OS-1-32-G_v2.1.1_1024x10"
    source = pcap.PcapFrameSetSource(str(ROOT / f"{name}.pcap"), meta=[str(ROOT / f"{name}.json")])
    frame = next(iter(source))[0]
    ranges_mm = frame.field("RANGE")
    vendor = core.XYZLut(source.sensor_info[0], use_extrinsics=False)(ranges_mm)
    ours = load_profile(str(ROOT / f"{name}.json")).project(ranges_mm / 1000.0)
    seen = ranges_mm > 0
    assert seen.sum() == 27310
    np.testing.assert_allclose(ours[seen], vendor[seen], atol=1e-6)


def test_calibration_of_a_uniform_unit_projects_as_the_vendor_does() -> None:
    path = ROOT / "2_0_rc2_os-992011000121-32U0_legacy.json"
    ranges_mm = np.random.default_rng(3).integers(300, 90_000, size=(32, 512)).astype(np.uint32)
    vendor = core.XYZLut(core.SensorInfo(path.read_text()), use_extrinsics=False)(ranges_mm)
    np.testing.assert_allclose(load_profile(str(path)).project(ranges_mm / 1000.0), vendor, atol=1e-6)


def test_first_generation_lists_64_beams_of_which_32_exist() -> None:
    sensor = load_profile(str(ROOT / "1_13_os1-991937000062-32A02_legacy.json"))
    assert sensor.height == 32
    assert (sensor.altitude_deg[0], sensor.altitude_deg[-1]) == (15.91, -16.858)
