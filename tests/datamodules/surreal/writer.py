"""Files as SURREAL has them, of known bodies; its world and camera as its own scripts write them, apart from ljn's.

The body is turned by matrices of the Blender scene, the camera is the product of `getIntrinsicBlender` and
`getExtrinsicBlender` of SURREAL's repository, written from their definitions.
"""

from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import numpy as np
import scipy.io
import torch
from scipy.spatial.transform import Rotation

from ljn.body import SMPL, load_body_models
from ljn.body.skeleton import JOINT_INDEX
from ljn.geometry.camera import Camera
from ljn.render import get_renderer

FIELDS = ("bg", "camDist", "camLoc", "clipNo", "cloth", "gender", "joints2D", "joints3D", "light", "pose", "sequence",
          "shape", "source", "stride", "zrot")  # fmt: skip


@cache
def layer():
    return SMPL(load_body_models(None, ["female", "male"])).double()


def projection(camera_place):
    """The matrix `(3, 4)` from SURREAL's world to its pixels."""
    f_mm, sensor_w_mm, sensor_h_mm, width, height = 60, 32, 24, 320, 240
    intrinsics = np.array(
        [[f_mm * width / sensor_w_mm, 0, width / 2], [0, f_mm * height / sensor_h_mm, height / 2], [0, 0, 1]]
    )
    world_from_blender = np.array([[0, 0, 1], [0, -1, 0], [-1, 0, 0]]).T
    blender_to_cv = np.diag([1, -1, -1])
    rotation = blender_to_cv @ world_from_blender
    assert np.linalg.det(rotation) == -1
    return intrinsics @ np.concatenate([rotation, -rotation @ camera_place[:, None]], 1)


def make_clip(seed=0, num_frames=4, gender=None, distance=6.0):
    """The fields of an `_info.mat` and, beside them, the bodies' vertices `(T, V, 3)` in SURREAL's world."""
    rng = np.random.default_rng(seed)
    gender = int(rng.integers(2)) if gender is None else gender
    pose = 0.15 * rng.standard_normal((num_frames, 72))
    standing = Rotation.from_euler("xz", [90, rng.uniform(-180, 180)], degrees=True)  # SMPL's y axis up to z
    pose[:, :3] = (standing * Rotation.from_rotvec(pose[:, :3])).as_rotvec()
    pose = pose.astype(np.float32)
    betas = np.tile(rng.standard_normal(10), (num_frames, 1)).astype(np.float32)
    zrot = np.full(num_frames, rng.uniform(0, 2 * np.pi)).astype(np.float32)

    filmed = pose.astype(float)
    turns = Rotation.from_euler("x", 90, degrees=True) * Rotation.from_euler("z", zrot[:, None])
    filmed[:, :3] = (turns * Rotation.from_rotvec(filmed[:, :3])).as_rotvec()
    codes = torch.full((num_frames,), gender)
    vertices, joints = layer()(torch.from_numpy(filmed), torch.from_numpy(betas).double(), codes)
    transl = np.array([rng.uniform(-0.3, 0.3), 0.0, rng.uniform(-1, 1)])
    vertices, joints = vertices.numpy() + transl, joints.numpy() + transl
    joints = joints.astype(np.float32)
    place = np.array([distance + rng.uniform(-0.5, 0.5), rng.uniform(-0.2, 0.4), 0.0]).astype(np.float32)
    place = place.astype(float)  # as it is in the file

    homogeneous = (
        np.concatenate([joints.astype(float), np.ones((num_frames, 24, 1))], -1) @ projection(place).T
    )
    pixels = np.round(homogeneous[..., :2] / homogeneous[..., 2:])
    names = np.full(num_frames, "some/where.jpg", dtype=object)
    fields = {
        "bg": names, "camDist": np.float32(distance), "camLoc": place[:, None].astype(np.float32), "clipNo": 1.0,
        "cloth": names, "gender": np.full((num_frames, 1), gender, np.uint8),
        "joints2D": pixels.astype(np.float32).transpose(2, 1, 0), "joints3D": joints.transpose(2, 1, 0),
        "light": np.zeros((9, 100), np.float32), "pose": pose.T, "sequence": "01_01_c0001", "shape": betas.T,
        "source": "cmu", "stride": np.uint8(50), "zrot": zrot[:, None],
    }  # fmt: skip
    if num_frames == 1:  # as MATLAB has it
        fields["joints2D"], fields["joints3D"] = fields["joints2D"][:, :, 0], fields["joints3D"][:, :, 0]
    return fields, vertices


def make_images(fields, vertices, radial=True):
    """The variables of a `_depth.mat` and of a `_segm.mat`: mirror images, background at 1e10."""
    place = np.asarray(fields["camLoc"], float).ravel()
    camera = Camera(600, 600, 159.5, 119.5, 320, 240)  # a pixel's middle is half a pixel from its edge
    x, y, z = np.moveaxis(vertices - place, -1, 0)
    seen = get_renderer("zbuffer")(torch.from_numpy(np.stack([-z, y, -x], -1)), layer().faces, camera).numpy()
    if radial:
        u, v = (np.arange(320) - 159.5) / 600, (np.arange(240) - 119.5) / 600
        seen = seen * np.sqrt(1 + u**2 + v[:, None] ** 2)
    depth = np.where(seen > 0, seen, 1e10).astype(np.float32)
    numbers = range(1, len(depth) + 1)
    return (
        {f"depth_{k}": depth[k - 1] for k in numbers},
        {f"segm_{k}": np.where(seen[k - 1] > 0, 1 + (k % 24), 0).astype(np.uint8) for k in numbers},
    )


MARKERS = {"l_wrist": (230, 20, 20), "r_wrist": (20, 20, 230)}
MARKER_PX = 5


def make_pictures(fields, parts):
    """Mirror images in colour `(T, 240, 320, 3)`: a wall of green that grows with the column, before it a grey person,
    the lighter the later the frame, with a red left and a blue right wrist.
    """
    joints = np.atleast_3d(fields["joints3D"]).transpose(2, 1, 0).astype(float)
    place = np.asarray(fields["camLoc"], float).ravel()
    matrix = projection(place)
    v, u = np.mgrid[:240, :320] + 0.5
    pictures = np.zeros((len(joints), 240, 320, 3))
    pictures[..., 1] = 40 + 0.6 * u
    for k, picture in enumerate(pictures):
        is_person = parts[f"segm_{k + 1}"] > 0
        picture[is_person] = person_grey(k)
        for name, colour in MARKERS.items():
            x, y, w = matrix @ [*joints[k, JOINT_INDEX[name]], 1]
            picture[is_person & (np.hypot(u - x / w, v - y / w) < MARKER_PX)] = colour
    return pictures.astype(np.uint8)


def person_grey(frame):
    """How light the person is in a frame."""
    return 80 + 20 * (frame % 8)


def write_video(path, pictures, rate=30):
    """As SURREAL's: H.264 with B-frames, 4:2:0; of better quality, that colours may be told apart."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate))
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "8"}
        for picture in [*pictures, None]:
            frame = None if picture is None else av.VideoFrame.from_ndarray(picture, "rgb24")
            container.mux(stream.encode(frame))


def write_mat(path, fields, compressed=False):
    path.parent.mkdir(parents=True, exist_ok=True)
    scipy.io.savemat(path, fields, do_compression=compressed)


def write_mat73(path, fields, h5py, cells=()):
    """As MATLAB's `save -v7.3`: HDF5 after a block of text, dimensions in reverse order, letters as numbers.

    Cell arrays refer to their cells; those of `cells` have one, with the field in it.
    """

    def add(place, value):
        is_text = isinstance(value, str)
        array = np.array([list(value.encode())], np.uint16) if is_text else np.atleast_2d(value)
        data = file.create_dataset(place, data=np.ascontiguousarray(array.T))
        kinds = {"float32": "single", "float64": "double", "uint16": "char", "uint8": "uint8"}
        data.attrs["MATLAB_class"] = np.bytes_(kinds[array.dtype.name])
        return data

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in fields.items():
            is_cells = name in cells or (isinstance(value, np.ndarray) and value.dtype == object)
            if not is_cells:
                add(name, value)
                continue
            content = [value] if name in cells else value
            cell = file.create_dataset(name, (len(content), 1), h5py.ref_dtype)
            for number, each in enumerate(content):
                cell[number, 0] = add(f"#refs#/{name}{number}", each).ref
            cell.attrs["MATLAB_class"] = np.bytes_("cell")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124, b" ") + b"\x00\x02IM")


def clip_path(root, split, sequence, number=1, run="run0"):
    """A clip's path without the ending."""
    return Path(root) / "cmu" / split / run / sequence / f"{sequence}_c{number:04d}"


def write_clip(
    root, split, sequence, number=1, images=False, video=False, radial=True, run="run0", **changes
):
    """One clip's files, its fields as `make_clip` makes them with `changes`, or instead of them those of `fields`.

    With `images` it has depth and parts, with `video` colours and parts.
    """
    given = changes.pop("fields", {})
    fields, vertices = make_clip(**changes)
    stem = clip_path(root, split, sequence, number, run)
    write_mat(stem.with_name(f"{stem.name}_info.mat"), {**fields, **given})
    if images or video:
        depth, parts = make_images(fields, vertices, radial)
        write_mat(stem.with_name(f"{stem.name}_segm.mat"), parts, compressed=True)
        if images:
            write_mat(stem.with_name(f"{stem.name}_depth.mat"), depth, compressed=True)
        if video:
            write_video(stem.with_name(f"{stem.name}.mp4"), make_pictures(fields, parts))
    return fields
