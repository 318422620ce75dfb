import json
import zipfile

import numpy as np
import pytest
from PIL import Image

from ljn.geometry.camera import Camera
from ljn.pipeline.inputs import read_camera, read_depth, read_keypoints, read_mask
from ljn.pipeline.writing import write_arrays, write_mesh

CAMERA = Camera(fx=100.5, fy=101.0, cx=10.0, cy=9.0, width=24, height=20)


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 3000, (20, 24)).astype(np.uint16)


def test_depth_comes_back_from_every_format_as_it_was_stored(image, tmp_path):
    Image.fromarray(image).save(tmp_path / "a.png")
    np.save(tmp_path / "b.npy", image / np.float32(1000))
    np.savez(tmp_path / "c.npz", image)
    np.savez_compressed(tmp_path / "d.npz", depth=image, rgb=image)
    np.testing.assert_array_equal(read_depth(tmp_path / "a.png"), image)
    assert read_depth(tmp_path / "a.png").dtype.kind in "iu"
    np.testing.assert_array_equal(read_depth(tmp_path / "b.npy"), image / np.float32(1000))
    np.testing.assert_array_equal(read_depth(tmp_path / "c.npz"), image)
    np.testing.assert_array_equal(read_depth(tmp_path / "d.npz"), image)


def test_what_is_no_depth_image_is_refused(image, tmp_path):
    Image.fromarray(image.astype(np.uint8)).save(tmp_path / "grey.png")
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "colour.png")
    for name in ("grey", "colour"):
        with pytest.raises(ValueError, match="expected a PNG of 16 bits with one channel"):
            read_depth(tmp_path / f"{name}.png")
    np.savez(tmp_path / "two.npz", a=image, b=image)
    with pytest.raises(ValueError, match=r"one with the key 'depth' in .*got \['a', 'b'\]"):
        read_depth(tmp_path / "two.npz")
    (tmp_path / "depth.exr").write_bytes(b"")
    with pytest.raises(ValueError, match=r"expected one of \.png, \.npy, \.npz"):
        read_depth(tmp_path / "depth.exr")


def test_a_missing_file_is_named(tmp_path):
    readers = {"depth": read_depth, "camera": read_camera, "keypoints": read_keypoints, "mask": read_mask}
    for name, read in readers.items():
        with pytest.raises(FileNotFoundError, match=f"{name}: no file '.*nowhere.png'"):
            read(tmp_path / "nowhere.png")


def test_an_archive_of_something_else_than_an_array_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "depth.npz", "w") as archive:
        archive.writestr("depth", "no array")
    with pytest.raises(ValueError, match=r"depth\.npz' is damaged.*magic string"):
        read_depth(tmp_path / "depth.npz")


def test_objects_in_an_array_file_are_never_loaded(tmp_path):
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="of another format"):
        read_depth(tmp_path / "objects.npy")


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA"])
def test_a_mask_of_any_kind_is_read(mode, tmp_path):
    body = np.zeros((20, 24), bool)
    body[5:9, 4:11] = True
    Image.fromarray(255 * body.astype(np.uint8)).convert(mode).save(tmp_path / "mask.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), body)


def test_cameras_are_read_from_yaml_and_json(tmp_path):
    values = vars(CAMERA)
    (tmp_path / "camera.json").write_text(json.dumps(values))
    (tmp_path / "camera.yaml").write_text("\n".join(f"{key}: {value}" for key, value in values.items()))
    assert read_camera(tmp_path / "camera.json") == CAMERA
    assert read_camera(tmp_path / "camera.yaml") == CAMERA


FOREIGN_CAMERAS = {
    "ros.yaml": """
image_width: 24
image_height: 20
camera_name: depth
camera_matrix: {rows: 3, cols: 3, data: [100.5, 0.0, 10.0, 0.0, 101.0, 9.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}
""",
    "opencv.yml": """%YAML:1.0
---
image_width: 24
image_height: 20
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 100.5, 0., 10., 0., 101., 9., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
""",
    "open3d.json": """{"width": 24, "height": 20, "intrinsic_matrix": [100.5, 0, 0, 0, 101.0, 0, 10.0, 9.0, 1]}""",
    "realsense.json": """{"width": 24, "height": 20, "ppx": 10.0, "ppy": 9.0, "fx": 100.5, "fy": 101.0,
        "model": "distortion.brown_conrady", "coeffs": [0, 0, 0, 0, 0]}""",
    "marked.json": "\ufeff" + json.dumps(vars(CAMERA)),
}


@pytest.mark.parametrize("name", FOREIGN_CAMERAS)
def test_cameras_of_other_programs_are_read(name, tmp_path):
    (tmp_path / name).write_text(FOREIGN_CAMERAS[name], encoding="utf-8")
    assert read_camera(tmp_path / name) == CAMERA


@pytest.mark.parametrize("name", ["ros.yaml", "opencv.yml", "realsense.json"])
def test_a_camera_with_distortion_is_refused(name, tmp_path):
    text = FOREIGN_CAMERAS[name]
    place = text.rfind("[") + 1  # of the coefficients
    (tmp_path / name).write_text(f"{text[:place]}0.09, {text[place:]}")
    with pytest.raises(ValueError, match=r"that are not 0.*undistort the images"):
        read_camera(tmp_path / name)


def test_a_matrix_of_open3d_row_by_row_is_refused(tmp_path):
    matrix = [100.5, 0, 10.0, 0, 101.0, 9.0, 0, 0, 1]
    (tmp_path / "camera.json").write_text(json.dumps({"width": 24, "height": 20, "intrinsic_matrix": matrix}))
    with pytest.raises(ValueError, match="column by column"):
        read_camera(tmp_path / "camera.json")


def test_a_camera_s_numbers_may_be_written_in_any_way(tmp_path):
    (tmp_path / "camera.json").write_text(
        '{"fx": 1.005e2, "fy": 101, "cx": "10", "cy": 9, "width": 24.0, "height": 20}'
    )
    assert read_camera(tmp_path / "camera.json") == CAMERA


def test_the_training_camera_is_read_from_the_configuration(kinect):
    assert read_camera("conf/data/camera/kinect_v2.yaml") == kinect


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fx: 1\nfy: 1", "cx, cy, width, height are missing"),
        (
            "fx: 1\nfy: 1\ncx: 1\ncy: 1\nwidth: 9\nheight: 9\nk1: 0.1",
            "k1 are unknown .a distortion is given as",
        ),
        ("fx: [1]\nfy: 1\ncx: 1\ncy: 1\nwidth: 9\nheight: 9", r"fx: expected a finite number.*got \[1\]"),
        ("fx: 1\nfy: wide\ncx: 1\ncy: 1\nwidth: 9\nheight: 9", "fy: expected a finite number.*got 'wide'"),
        ("fx: 1\nfy: 1\ncx: 1\ncy: true\nwidth: 9\nheight: 9", "cy: expected a finite number.*got True"),
        ("fx: 1\nfy: 1\ncx: 1\ncy: 1\nwidth: .inf\nheight: 9", "width: expected a finite number.*got inf"),
        ("fx: 1\nfy: 1\ncx: 1\ncy: 1\nwidth: 4.9\nheight: 9", r"width: expected a whole number.*got 4\.9"),
        ("fx: 2001-99-99\nfy: 1", "is damaged"),
        ("fx: 1\nfy: 1\ncx: 1\ncy: 8\nwidth: 9\nheight: 5", "principal point.*lies outside.*swapped"),
        ("fx: {", "is damaged"),
        ("- 3", "expected the keys"),
    ],
)
def test_a_bad_camera_file_is_refused(text, message, tmp_path):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_camera(tmp_path / "camera.yaml")


def test_arrays_come_back(pipeline, given, kinect, tmp_path):
    found = pipeline(given[0], kinect, given[1])
    write_arrays(tmp_path / "found.npz", found, kinect)
    with np.load(tmp_path / "found.npz") as arrays:
        assert set(arrays.files) == {*found.arrays, "camera"}
        for name, value in found.arrays.items():
            np.testing.assert_array_equal(arrays[name], value)
        assert Camera(*arrays["camera"]) == kinect


@pytest.mark.parametrize(("suffix", "axes"), [(".ply", [1, 1, 1]), (".glb", [1, -1, -1])])
def test_meshes_come_back(suffix, axes, pipeline, given, kinect, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    found = pipeline(given[0], kinect, given[1])
    write_mesh(tmp_path / f"mesh{suffix}", found.vertices, found.faces)
    mesh = trimesh.load(tmp_path / f"mesh{suffix}", process=False, force="mesh")
    np.testing.assert_allclose(mesh.vertices, found.vertices * axes, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, found.faces)
