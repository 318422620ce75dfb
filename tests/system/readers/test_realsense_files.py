"""Files as RealSense's own driver writes them; without pyrealsense2 these tests are skipped."""

import time

import numpy as np
import pytest

from ljn.system.readers import open_recording
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, turned

rs = pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install -e '.[realsense]'")


def stream(kind, uid, camera, form, num_bytes, lens=(0.0,) * 5):
    found = rs.video_stream()
    found.type, found.uid, found.index, found.fmt = kind, uid, 0, form
    found.width, found.height, found.fps, found.bpp = camera.width, camera.height, 30, num_bytes
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = camera.width, camera.height
    intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = camera.fx, camera.fy, camera.cx, camera.cy
    intrinsics.model, intrinsics.coeffs = rs.distortion.inverse_brown_conrady, list(lens)
    found.intrinsics = intrinsics
    return found


def image(pixels, number, profile):
    found = rs.software_video_frame()
    found.pixels, found.profile = pixels, profile.as_video_stream_profile()
    found.bpp = pixels.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1)
    found.stride = pixels.shape[1] * found.bpp
    found.timestamp, found.domain = 1000 + 33.3 * number, rs.timestamp_domain.hardware_clock
    found.frame_number, found.depth_units = number + 1, 0.001
    return found


@pytest.mark.slow
def test_a_file_of_the_driver_comes_back(tmp_path):
    device, motion = rs.software_device(), turned(3, [-0.05, 0.01, 0.0])
    device.register_info(rs.camera_info.name, "software")
    sensors = device.add_sensor("Depth"), device.add_sensor("Color")
    depth_profile = sensors[0].add_video_stream(stream(rs.stream.depth, 0, DEPTH_CAMERA, rs.format.z16, 2))
    rgb_profile = sensors[1].add_video_stream(
        stream(rs.stream.color, 1, RGB_CAMERA, rs.format.rgb8, 3, (0.05, -0.02, 0.001, 0.0, 0.01))
    )
    sensors[0].add_read_only_option(rs.option.depth_units, 0.001)
    extrinsics = rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = motion[:3, :3].T.ravel().tolist(), motion[:3, 3].tolist()
    depth_profile.register_extrinsics_to(rgb_profile, extrinsics)
    recorder, queue = rs.recorder(str(tmp_path / "walk.db3"), device), rs.frame_queue(50)
    for sensor in (recorded := recorder.query_sensors()):
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    for number in range(5):
        depth = np.full((DEPTH_CAMERA.height, DEPTH_CAMERA.width), 1500 + number, np.uint16)
        rgb = np.full((RGB_CAMERA.height, RGB_CAMERA.width, 3), 10 * number + 5, np.uint8)
        sensors[0].on_video_frame(image(depth, number, depth_profile))
        sensors[1].on_video_frame(image(rgb, number, rgb_profile))
        time.sleep(0.1)
    for sensor in recorded:
        sensor.stop()
        sensor.close()
    del recorder

    recording = open_recording(tmp_path / "walk.db3")
    for name, value in vars(DEPTH_CAMERA).items():
        assert getattr(recording.camera, name) == pytest.approx(value)
    found = list(recording.frames())
    assert len(found) >= 4  # the driver may keep the last, which waits for its colours, to itself
    assert [frame.number for frame in found] == list(range(len(found)))
    for number, frame in enumerate(found):
        np.testing.assert_allclose(frame.depth, 1.5 + number / 1000, atol=1e-5)
        assert set(np.unique(frame.rgb)) == {0, 10 * number + 5}
        assert frame.timestamp_s == pytest.approx(0.0333 * number)
    assert next(open_recording(tmp_path / "walk.db3").frames(3)).number == 3
