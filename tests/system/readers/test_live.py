import logging
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from ljn.system.readers import LensCamera, open_recording
from ljn.system.readers.alignment import Alignment
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, as_tuples, cast, turned

MOTION = turned(2, [-0.05, 0.01, 0.0])
LENS = (0.05, -0.02, 0.001, 0.0, 0.01)


@pytest.fixture(scope="module")
def raw(scene):
    """What a sensor's two cameras see: depth in millimetres and colours."""
    millimetres = np.rint(scene[0] * 1000).astype(np.uint16)
    return millimetres, cast(RGB_CAMERA, np.linalg.inv(MOTION))[2]


@pytest.fixture(scope="module")
def registered(scene, raw):
    """The colours of the depth's pixels."""
    return Alignment(LensCamera(DEPTH_CAMERA), LensCamera(RGB_CAMERA, LENS, as_tuples(MOTION)))(
        scene[0], raw[1]
    )[1]


class Fake(SimpleNamespace):
    """A driver's object of some attributes; functions of no argument among them give what stands behind them."""


def give(value):
    return lambda *args, **kwargs: value


# pyrealsense2


class FakeImage(Fake):
    def get_data(self):
        return self.image

    def get_timestamp(self):
        return self.time_ms

    def get_frame_number(self):
        return self.number

    def __bool__(self):
        return self.image is not None


def intrinsics(camera, model="brown_conrady", coeffs=(0.0,) * 5):
    size = {"width": camera.width, "height": camera.height}
    place = {"fx": camera.fx, "fy": camera.fy, "ppx": camera.cx, "ppy": camera.cy}
    return Fake(**size, **place, model=f"distortion.{model}", coeffs=list(coeffs))


ALL = [(i, i) for i in range(4)]  # numbers of depth and colours that come together


def fake_realsense(monkeypatch, raw, sets=ALL, model="inverse_brown_conrady", damaged=()):
    module = ModuleType("pyrealsense2")
    module.opened = []

    class Pipeline:
        def __init__(self):
            self.number, self.is_running = 0, False
            module.opened.append(self)

        def start(self, config):
            if not module.is_plugged_in:
                raise RuntimeError("No device connected")
            self.is_running, self.config = True, config
            extrinsics = Fake(rotation=MOTION[:3, :3].T.ravel().tolist(), translation=MOTION[:3, 3].tolist())
            profiles = {
                "depth": Fake(
                    get_intrinsics=give(intrinsics(DEPTH_CAMERA)),
                    get_extrinsics_to=give(extrinsics),
                    fps=give(30),
                ),
                "color": Fake(get_intrinsics=give(intrinsics(RGB_CAMERA, model, LENS))),
            }
            for profile in profiles.values():
                profile.as_video_stream_profile = give(profile)
            device = Fake(
                first_depth_sensor=give(Fake(get_depth_scale=give(0.001))),
                get_info=give("Intel RealSense D455"),
                as_playback=give(Fake(set_real_time=give(None), seek=give(None))),
            )
            return Fake(get_device=give(device), get_stream=profiles.get)

        def try_wait_for_frames(self, timeout_ms):
            assert self.is_running
            if self.number == len(sets):
                return False, None
            number, rgb_number = sets[self.number]
            self.number += 1
            depth = FakeImage(image=raw[0], time_ms=5000 + 100.0 * number, number=number)
            image = None if rgb_number in damaged else raw[1] if number == rgb_number else 0 * raw[1]
            rgb = FakeImage(image=image, time_ms=5003 + 100.0 * rgb_number, number=rgb_number)
            return True, Fake(get_depth_frame=give(depth), get_color_frame=give(rgb))

        def stop(self):
            self.is_running = False

    class Config:
        def __init__(self):
            self.streams, self.file = [], None

        def enable_stream(self, *stream):
            self.streams.append(stream)

        def enable_device_from_file(self, file, repeat_playback=True):
            assert not repeat_playback
            self.file = file

    module.is_plugged_in = True
    module.pipeline, module.config = Pipeline, Config
    module.stream = Fake(depth="depth", color="color")
    module.format = Fake(z16="z16", rgb8="rgb8")
    module.camera_info = Fake(name="name")
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    return module


def test_a_realsense_gives_registered_frames_until_it_stops(monkeypatch, scene, raw, registered, caplog):
    driver = fake_realsense(monkeypatch, raw, damaged=[2])
    recording = open_recording("live:realsense")
    assert recording.camera == DEPTH_CAMERA
    assert recording.num_frames is None
    assert recording.fps == 30
    with caplog.at_level(logging.WARNING):
        found = list(recording.frames())
    assert [frame.number for frame in found] == [0, 1, 2, 3]
    for number in (0, 1, 3):
        np.testing.assert_array_equal(found[number].depth, scene[0])
        np.testing.assert_array_equal(found[number].rgb, registered)
        assert found[number].timestamp_s == pytest.approx(0.1 * number)
    assert found[2].depth is None
    assert "without colours" in found[2].error
    assert recording.facts["unreadable"] == 1
    assert "no frame for 5 s" in recording.facts["ended"]
    assert "no frame for 5 s" in caplog.text
    assert recording.facts["sensor"] == "Intel RealSense D455"
    assert not driver.opened[0].is_running
    with pytest.raises(RuntimeError, match="open it again"):
        recording.frames()


def test_a_sensor_is_closed_when_its_frames_are_no_longer_taken(monkeypatch, raw):
    driver = fake_realsense(monkeypatch, raw)
    frames = open_recording("live:realsense").frames(7)
    assert next(frames).number == 7
    assert driver.opened[0].is_running
    frames.close()
    assert not driver.opened[0].is_running


def test_a_bag_is_a_recording_that_can_be_begun_later(monkeypatch, raw, registered, tmp_path):
    # As the driver plays them: a depth image comes with the colours before it, and again with its own.
    sets = [(0, 0), (1, 0), (1, 1), (1, 2), (2, 2), (3, 2), (3, 3)]
    driver = fake_realsense(monkeypatch, raw, sets)
    (tmp_path / "walk.bag").write_bytes(b"#ROSBAG V2.0")
    recording = open_recording(tmp_path / "walk.bag")
    assert driver.opened[0].config.file.endswith("walk.bag")
    assert recording.name == "walk"
    found = list(recording.frames(1))
    assert [frame.number for frame in found] == [1, 2, 3]
    np.testing.assert_allclose([frame.timestamp_s for frame in found], [0.1, 0.2, 0.3])
    for frame in found:
        np.testing.assert_array_equal(frame.rgb, registered)
    assert recording.facts["ended"] == "the file is over"
    assert recording.facts["layout"] == "RealSense .bag"


def test_a_sensor_gives_no_depth_image_twice(monkeypatch, raw):
    fake_realsense(monkeypatch, raw, [(0, 0), (0, 1), (1, 1), (1, 2)])
    found = list(open_recording("live:realsense").frames())
    assert [frame.number for frame in found] == [0, 1]


def test_a_realsense_that_is_not_there_or_not_known_is_an_error(monkeypatch, raw):
    driver = fake_realsense(monkeypatch, raw, model="ftheta")
    with pytest.raises(ValueError, match=r"distortion: expected one of .* the sensor has ftheta"):
        open_recording("live:realsense")
    assert not driver.opened[0].is_running
    driver.is_plugged_in = False
    with pytest.raises(RuntimeError, match=r"no RealSense camera .*No device connected.* plugged in"):
        open_recording("live:realsense")


# pyk4a


def fake_azure(monkeypatch, raw, num_frames=3):
    module = ModuleType("pyk4a")
    module.K4AException = type("K4AException", (Exception,), {})
    module.K4ATimeoutException = type("K4ATimeoutException", (module.K4AException,), {})
    module.CalibrationType = Fake(DEPTH="depth", COLOR="color")
    module.ColorResolution, module.DepthMode, module.FPS = (
        Fake(RES_720P=1),
        Fake(NFOV_UNBINNED=2),
        Fake(FPS_30=2),
    )
    module.Config = lambda **settings: settings
    cameras = {"depth": DEPTH_CAMERA, "color": RGB_CAMERA}
    lenses = {"depth": np.zeros(8), "color": np.array([*LENS, 0, 0, 0])}

    class PyK4A:
        def __init__(self, config):
            self.number, self.is_running = 0, False
            self.calibration = Fake(
                get_camera_matrix=lambda kind: np.array(
                    [
                        [cameras[kind].fx, 0, cameras[kind].cx],
                        [0, cameras[kind].fy, cameras[kind].cy],
                        [0, 0, 1],
                    ]
                ),
                get_distortion_coefficients=lenses.get,
                get_extrinsic_parameters=lambda source, target: (MOTION[:3, :3], MOTION[None, :3, 3]),
            )
            module.device = self

        def start(self):
            if num_frames is None:
                raise module.K4AException
            self.is_running = True

        def stop(self):
            assert self.is_running
            self.is_running = False

        def get_capture(self, timeout):
            if self.number > num_frames:
                raise module.K4ATimeoutException
            self.number += 1
            bgra = np.concatenate([raw[1][..., ::-1], np.full((*raw[1].shape[:2], 1), 255, np.uint8)], -1)
            depth = None if self.number == 3 else raw[0]
            return Fake(depth=depth, color=bgra, depth_timestamp_usec=33_333 * self.number)

    module.PyK4A = PyK4A
    monkeypatch.setitem(sys.modules, "pyk4a", module)
    return module


def test_an_azure_kinect_gives_registered_frames_until_it_stops(monkeypatch, scene, raw, registered):
    driver = fake_azure(monkeypatch, raw)
    recording = open_recording("live:azure")
    assert recording.camera == DEPTH_CAMERA
    found = list(recording.frames())
    np.testing.assert_array_equal(found[0].depth, scene[0])
    np.testing.assert_array_equal(found[0].rgb, registered)
    assert "without depth" in found[1].error
    assert found[2].timestamp_s == pytest.approx(0.0667, abs=1e-3)
    assert len(found) == 3
    assert "no frame for" in recording.facts["ended"]
    assert not driver.device.is_running


def test_an_azure_kinect_that_is_not_there_is_an_error(monkeypatch, raw):
    fake_azure(monkeypatch, raw, num_frames=None)
    with pytest.raises(RuntimeError, match=r"no Azure Kinect can be opened .* plugged in"):
        open_recording("live:azure")


# freenect2


def fake_kinect2(monkeypatch, depth, rgb, num_frames=3):
    """Its images are mirrored, as those of the driver."""
    module = ModuleType("freenect2")
    module.NoDeviceError = type("NoDeviceError", (RuntimeError,), {})

    class Image(Fake):
        def to_array(self):
            return self.image

    class Device:
        def __init__(self):
            if not num_frames:
                raise module.NoDeviceError
            self.is_running = False
            self.ir_camera_params = Fake(fx=366.0, fy=366.5, cx=250.0, cy=205.0)
            self.registration = Fake(apply=lambda rgb, depth: (depth, rgb))
            module.device = self

        def start(self, listener):
            self.is_running = True
            bgrx = np.concatenate([rgb[:, ::-1, ::-1], np.zeros((*rgb.shape[:2], 1), np.uint8)], -1)
            for _ in range(num_frames):  # those that nobody takes in time are lost
                listener(Fake(name="Ir"), None)
                listener(Fake(name="Color"), Image(image=bgrx, format=Fake(name="BGRX")))
                listener(Fake(name="Depth"), Image(image=1000 * depth[:, ::-1]))

        def stop(self):
            self.is_running = False

        def close(self):
            assert not self.is_running

    module.Device = Device
    monkeypatch.setitem(sys.modules, "freenect2", module)
    return module


def test_a_kinect_v2_gives_its_newest_frame_unmirrored(monkeypatch):
    monkeypatch.setattr("ljn.system.readers.kinect2.TIMEOUT_S", 0.01)
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 3, (424, 512)).astype(np.float32)
    rgb = rng.integers(0, 255, (424, 512, 3)).astype(np.uint8)
    driver = fake_kinect2(monkeypatch, np.where(depth > 2.9, np.inf, depth), rgb)
    recording = open_recording("live:kinect2")
    assert recording.camera.cx == 511 - 250
    (frame,) = recording.frames()
    np.testing.assert_allclose(frame.depth, np.where(depth > 2.9, 0, depth), rtol=1e-6)
    np.testing.assert_array_equal(frame.rgb, rgb)
    assert "no frame" in recording.facts["ended"]
    assert not driver.device.is_running
    fake_kinect2(monkeypatch, depth, rgb, num_frames=0)
    with pytest.raises(RuntimeError, match="no Kinect v2 can be opened"):
        open_recording("live:kinect2")


# What is not there


DRIVERS = {"realsense": "pyrealsense2", "azure": "pyk4a", "kinect2": "freenect2"}


@pytest.mark.parametrize(("source", "module"), DRIVERS.items())
def test_a_missing_driver_is_named_with_its_extra(monkeypatch, source, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"{module} cannot be loaded .*\.\[{source}\].*live:replay:PATH"):
        open_recording(f"live:{source}")


def test_another_sensor_is_refused():
    with pytest.raises(ValueError, match=r"expected live:realsense, .* got 'live:webcam'"):
        open_recording("live:webcam")
    with pytest.raises(ValueError, match="says itself what it is"):
        open_recording("live:azure", DEPTH_CAMERA)
