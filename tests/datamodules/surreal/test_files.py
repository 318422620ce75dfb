import numpy as np
import pytest
import scipy.io

from datamodules.sources.surreal import matlab
from datamodules.sources.surreal.files import read_clip, read_filmed_clip, read_images
from datamodules.sources.surreal.world import to_mirrored_camera, to_pixels
from tests.datamodules.surreal.conftest import plain_fields
from tests.datamodules.surreal.writer import FIELDS, make_clip, projection, write_mat, write_mat73


@pytest.mark.parametrize("num_frames", [1, 3])
@pytest.mark.parametrize("version", ["5", "5 compressed", "7.3", "7.3 with cells"])
def test_a_clip_is_what_was_written_in_every_version_of_matlab(num_frames, version, tmp_path, request):
    fields, _ = make_clip(seed=3, num_frames=num_frames)
    assert set(fields) == set(FIELDS)
    path = tmp_path / "a_info.mat"
    if version.startswith("5"):
        write_mat(path, fields, compressed="compressed" in version)
    else:
        write_mat73(path, fields, request.getfixturevalue("h5py"), cells=("gender",) * ("cells" in version))
    clip = read_filmed_clip(path)
    assert len(clip) == num_frames
    np.testing.assert_array_equal(clip.pose, fields["pose"].reshape(72, num_frames).T)
    np.testing.assert_array_equal(clip.betas, fields["shape"].reshape(10, num_frames).T)
    np.testing.assert_array_equal(clip.gender, fields["gender"].ravel())
    np.testing.assert_array_equal(clip.zrot, fields["zrot"].ravel())
    np.testing.assert_array_equal(clip.camera_place, fields["camLoc"].ravel())
    for name, values in (("joints2D", clip.pixels), ("joints3D", clip.joints)):
        np.testing.assert_array_equal(values, fields[name].reshape(-1, 24, num_frames).transpose(2, 1, 0))
    assert clip.is_good.all()
    np.testing.assert_array_equal(read_clip(path).pose, clip.pose)


def test_vectors_may_be_rows_and_one_shape_may_stand_for_all_frames(tmp_path):
    fields = plain_fields(num_frames=1)
    write_mat(tmp_path / "row.mat", {name: np.ravel(value) for name, value in fields.items()})
    np.testing.assert_array_equal(read_clip(tmp_path / "row.mat").pose[0], fields["pose"][:, 0])
    fields = plain_fields(num_frames=5)
    write_mat(tmp_path / "one.mat", fields | {"shape": fields["shape"][:, :1], "gender": 1})
    clip = read_clip(tmp_path / "one.mat")
    assert (clip.betas.shape, clip.gender.tolist()) == ((5, 10), [1] * 5)


def test_points_fall_where_surreals_own_matrices_project_them():
    rng = np.random.default_rng(0)
    place = np.array([7.0, -0.5, 0.2])
    points = rng.uniform(-1, 1, (50, 3))
    expected = np.concatenate([points, np.ones((50, 1))], 1) @ projection(place).T
    found = to_pixels(to_mirrored_camera(points, place))
    np.testing.assert_allclose(found, expected[:, :2] / expected[:, 2:], atol=1e-9)


def test_a_joint_of_a_real_file_falls_on_its_pixel():
    """From the comments of `main.m` in SURREAL's repository, of 01_01_c0001."""
    place = np.array([6.7456, -0.9839, -1.9293])
    pixel = to_pixels(to_mirrored_camera(np.array([-0.8645, -1.0915, -1.0260]), place))
    assert np.round(pixel).tolist() == [89, 112]


def without(name):
    return lambda fields: {key: value for key, value in fields.items() if key != name}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("pose"), r"a_info\.mat: no field pose; expected a file of SURREAL's"),
        (lambda fields: {"depth_1": np.zeros((240, 320))}, "no field pose, shape, gender"),
        (lambda fields: fields | {"pose": np.zeros((66, 8))}, r"pose: expected shape \(72, T\), got \(66, 8\)"),
        (lambda fields: fields | {"pose": np.zeros((72, 0))}, r"pose: expected shape \(72, T\), got \(72, 0\)"),
        (lambda fields: fields | {"shape": np.zeros((10, 7))}, "shape: expected the 8 frames of pose, got 7"),
        (lambda fields: fields | {"gender": np.zeros((2, 4))}, "gender: expected a number for each frame"),
        (lambda fields: fields | {"gender": 2}, r"gender: expected 0 \(female\) or 1 \(male\), got \[2\]"),
        (lambda fields: fields | {"gender": "female"}, "gender: expected numbers, got text"),
        (lambda fields: fields | {"pose": {"a": 1}}, "pose: expected numbers, got a structure"),
    ],
)  # fmt: skip
def test_the_file_and_the_field_that_are_wrong_are_named(change, message, tmp_path):
    write_mat(tmp_path / "a_info.mat", change(plain_fields()))
    with pytest.raises(ValueError, match=message):
        read_clip(tmp_path / "a_info.mat")


def test_a_truncated_and_a_renamed_file_are_called_damaged(tmp_path, h5py):
    path = tmp_path / "a_info.mat"
    write_mat(path, plain_fields())
    whole = path.read_bytes()
    write_mat73(path, plain_fields(), h5py)
    for content in (whole[:3000], whole[:100], b"", b"\x89PNG\r\n" + bytes(5000), path.read_bytes()[:2000]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a_info\.mat: cannot be read as a MATLAB file"):
            read_clip(path)
    path.write_bytes(b"\n<!DOCTYPE html><html>401 Unauthorized</html>")
    with pytest.raises(ValueError, match="it is a web page"):
        read_clip(path)
    with pytest.raises(FileNotFoundError):
        read_clip(tmp_path / "none.mat")


def test_links_into_other_files_are_not_followed(tmp_path, h5py):
    path = tmp_path / "a_info.mat"
    write_mat73(path, plain_fields(), h5py)
    path.rename(tmp_path / "other.mat")
    with h5py.File(path, "w") as file:
        for name in ("pose", "shape", "gender"):
            file[name] = h5py.ExternalLink(str(tmp_path / "other.mat"), name)
    with pytest.raises(ValueError, match="pose is a link"):
        read_clip(path)


def test_a_field_of_hdf5_without_content_is_named(tmp_path, h5py):
    write_mat73(tmp_path / "a_info.mat", plain_fields(), h5py)
    with h5py.File(tmp_path / "a_info.mat", "r+") as file:
        del file["gender"]
        file["gender"] = h5py.Empty("f4")
    with pytest.raises(ValueError, match=r"gender: expected .*, got"):
        read_clip(tmp_path / "a_info.mat")


def test_pieces_that_are_none_are_damage(tmp_path):
    path = tmp_path / "a_info.mat"
    write_mat(path, plain_fields())
    path.write_bytes(path.read_bytes() + bytes(64))  # room for what has not come yet
    with pytest.raises(ValueError, match="a piece of kind 0, where an array was expected"):
        read_clip(path)


def test_without_h5py_the_command_that_installs_it_is_named(tmp_path, monkeypatch, h5py):
    write_mat73(tmp_path / "a_info.mat", plain_fields(), h5py)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(ImportError, match="pip install h5py"):
        read_clip(tmp_path / "a_info.mat")
    assert matlab.import_h5py


def test_frames_that_are_not_finite_are_known(tmp_path):
    fields, _ = make_clip(num_frames=5)
    fields["pose"] = fields["pose"].copy()
    fields["pose"][3, 1] = np.nan
    fields["shape"] = fields["shape"].copy()
    fields["shape"][0, 2] = 1e30
    fields["joints3D"][1, 5, 4] = np.inf
    write_mat(tmp_path / "a.mat", fields)
    assert read_clip(tmp_path / "a.mat").is_good.tolist() == [True, False, False, True, True]
    assert read_filmed_clip(tmp_path / "a.mat").is_good.tolist() == [True, False, False, True, False]


def test_images_are_read_by_their_numbers(tmp_path):
    images = np.random.default_rng(0).random((3, 240, 320)).astype(np.float32)
    scipy.io.savemat(tmp_path / "d.mat", {f"depth_{k + 1}": image for k, image in enumerate(images)})
    found = read_images(tmp_path / "d.mat", "depth", [2, 0])
    np.testing.assert_array_equal(found, images[[2, 0]])
    with pytest.raises(ValueError, match=r"d\.mat: no field depth_4"):
        read_images(tmp_path / "d.mat", "depth", [3])
    scipy.io.savemat(tmp_path / "d.mat", {"depth_1": images[0].T})
    with pytest.raises(ValueError, match=r"depth_1: expected an image of \(240, 320\), got \(320, 240\)"):
        read_images(tmp_path / "d.mat", "depth", [0])
