import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ljn.system.readers import LensCamera
from ljn.system.readers.cameras import read_lens_camera
from tests.system.readers.conftest import DEPTH_CAMERA, RGB_CAMERA, as_tuples, turned
from tests.system.readers.test_layouts import write_camera


def test_a_colour_camera_is_read_with_its_lens_and_place(tmp_path):
    motion = turned(20, [0.05, -0.01, 0.002])
    x, y, z, w = Rotation.from_matrix(motion[:3, :3]).as_quat().tolist()
    place = {"translation": motion[:3, 3].tolist()}
    forms = [
        {"extrinsics": {"rotation": motion[:3, :3].tolist(), **place}},
        {"extrinsics": {"quaternion_xyzw": [x, y, z, w], **place}},
        {"extrinsics": {"quaternion_wxyz": [w, x, y, z], **place}},
        {"extrinsics": {"rgb_from_depth": motion.tolist()}},
        {"extrinsics": motion.ravel().tolist()},
        {"rgb_from_depth": motion.tolist()},
    ]
    lens = {"distortion_model": "plumb_bob", "distortion_coefficients": [0.1, -0.2, 0.001, 0.002, 0.05]}
    for form in forms:
        write_camera(tmp_path / "rgb_camera.yaml", RGB_CAMERA, **lens, **form)
        found, others = read_lens_camera(tmp_path / "rgb_camera.yaml", is_rgb=True)
        assert found.camera == RGB_CAMERA
        assert found.distortion == (0.1, -0.2, 0.001, 0.002, 0.05)
        np.testing.assert_allclose(found.motion, motion, atol=1e-9)
        assert others == {}
    write_camera(tmp_path / "rgb_camera.yaml", RGB_CAMERA)
    assert read_lens_camera(tmp_path / "rgb_camera.yaml", is_rgb=True)[0] == LensCamera(RGB_CAMERA)


SHIFT = {"translation": [0.05, 0, 0]}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"extrinsics": {"rotation": [[1, 0], [0, 1]], **SHIFT}}, "rotation: expected 9 numbers"),
        (
            {"extrinsics": {"rotation": np.eye(3).tolist(), "translation": [52.0, 0, 0]}},
            "got 52: millimetres",
        ),
        ({"extrinsics": {"rotation": (2 * np.eye(3)).tolist(), **SHIFT}}, "expected a rotation"),
        ({"extrinsics": {"rotation": np.diag([1.0, 1, -1]).tolist(), **SHIFT}}, "expected a rotation"),
        ({"extrinsics": {"quaternion_xyzw": [1, 1, 0, 0], **SHIFT}}, "unit quaternion"),
        ({"extrinsics": {"quaternion": [0, 0, 0, 1], **SHIFT}}, "got quaternion"),
        ({"extrinsics": {"rotation": np.eye(3).tolist()}}, "translation: expected 3 numbers, got None"),
        ({"extrinsics": np.eye(4)[:3].tolist()}, "expected 16 numbers"),
        ({"rgb_from_depth": (np.eye(4) + 1e-3).tolist()}, "last row 0, 0, 0, 1"),
        ({"extrinsics": "left"}, "expected 16 numbers"),
        ({"distortion_model": "equidistant", "D": [0.1, 0, 0, 0]}, "'equidistant', a fisheye"),
        ({"distortion_coefficients": [0.1, 0.2, 0.3]}, "expected 4, 5 or 8 of OpenCV's coefficients"),
        ({"distortion_coefficients": [0.1] * 12}, "expected 4, 5 or 8"),
        ({"distortion_coefficients": [0.1, "nan", 0, 0]}, "expected finite numbers"),
        ({"k1": 0.1}, "k1 are unknown"),
    ],
)
def test_a_wrong_colour_camera_is_refused(values, message, tmp_path):
    write_camera(tmp_path / "rgb_camera.yaml", RGB_CAMERA, **values)
    with pytest.raises(ValueError, match=message):
        read_lens_camera(tmp_path / "rgb_camera.yaml", is_rgb=True)


def test_a_depth_camera_has_no_place(tmp_path):
    write_camera(tmp_path / "camera.yaml", DEPTH_CAMERA, rgb_from_depth=as_tuples(np.eye(4)))
    with pytest.raises(ValueError, match="rgb_from_depth are unknown"):
        read_lens_camera(tmp_path / "camera.yaml")
