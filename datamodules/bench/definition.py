"""The benchmark's definition: every number that its samples are made of, in one small file."""

import hashlib
import io
import math
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from datamodules.placement import draw_heading, place
from datamodules.posing import varied_camera
from datamodules.sources.embedded import EmbeddedSource
from ljn.body import GENDERS, BodyModel, SparseSMPL, load_body_models
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import body_to_camera, rotation_about, rotmat_to_rotvec, rotvec_to_rotmat
from ljn.reading import READ_ERRORS, read_arrays, reason
from ljn.runs.files import write_atomically

VERSION = "ljn-bench-1"
"""Of the shipped definition. Numbers of one version can be compared; another definition is another version."""
PATH = Path(__file__).parent / "data" / "ljn_bench_1.npz"
NUM_SAMPLES = 2000
KINECT_V2 = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
"""Stood upright, as in `conf/data/camera/kinect_v2.yaml`."""
DISTANCE_M = (1.0, 5.0)
"""Range of the depth of the middle of the body's box, uniform; raised where the body would not fit into the image."""
FOCAL_FACTORS, PIXEL_FACTORS = (0.8, 1.6), (0.3, 1.0)
"""Ranges of each sample's focal length and of its image's sides, as multiples of the camera's, log-uniform."""
MARGIN_PX = 4.0
"""Clear border around the body, pixels."""
CHUNK = 16
"""Bodies posed at once: products over a batch of one size round alike."""
_SEED = 20261
_PLACE, _CAMERA, _NOISE = range(3)
_FORMS: dict[str, tuple[str, tuple[int, ...]]] = {
    "pose": ("<f2", (72,)), "betas": ("<f2", (10,)), "gender": ("|u1", ()), "transl": ("<f4", (3,)),
    "intrinsics": ("<f4", (4,)), "size": ("<i2", (2,)), "seed": ("<u4", ()), "kind": ("<U10", ()),
}  # fmt: skip


@dataclass(frozen=True)
class Definition:
    """A table of samples, a row each; the numbers as they are stored are the definition, to the last bit.

    Attributes:
        pose: `(S, 72)` float16 axis-angle, radians; the first three place the body in the body world (z up, x towards
            the camera), heading included.
        betas: `(S, 10)` float16 shape coefficients.
        gender: `(S,)` uint8, codes of `ljn.body.GENDERS`.
        transl: `(S, 3)` float32, metres, camera frame: added to the body in the camera's axes.
        intrinsics: `(S, 4)` float32: fx, fy, cx, cy, pixels.
        size: `(S, 2)` int16: width and height of the image, pixels.
        seed: `(S,)` uint32, of all that is drawn for the sample: noise, missing keypoints, occlusion.
        kind: `(S,)` str, the kind of pose: a procedural family, `clip` or `recombined`.
    """

    pose: np.ndarray
    betas: np.ndarray
    gender: np.ndarray
    transl: np.ndarray
    intrinsics: np.ndarray
    size: np.ndarray
    seed: np.ndarray
    kind: np.ndarray

    def __post_init__(self) -> None:
        for name, (dtype, tail) in _FORMS.items():
            values = getattr(self, name)
            expected = (len(self.pose), *tail)
            if values.shape != expected or values.dtype != np.dtype(dtype):
                raise ValueError(
                    f"{name}: expected {np.dtype(dtype)} of shape {expected}, got {values.dtype} of {values.shape}; "
                    "python -m datamodules.bench makes the file again"
                )
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise ValueError(
                    f"{name}: NaN or infinite values; python -m datamodules.bench makes it again"
                )

    def __len__(self) -> int:
        return len(self.pose)

    def first(self, num_samples: int) -> "Definition":
        """The first samples."""
        return Definition(**{field.name: getattr(self, field.name)[:num_samples] for field in fields(self)})

    @cached_property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 over all columns' bytes."""
        digest = hashlib.sha256(f"{len(self)}".encode())
        for name, (dtype, _) in _FORMS.items():
            digest.update(np.ascontiguousarray(getattr(self, name), dtype).tobytes())
        return digest.hexdigest()[:16]

    def camera(self, index: int) -> Camera:
        """A sample's camera."""
        fx, fy, cx, cy = map(float, self.intrinsics[index])
        width, height = map(int, self.size[index])
        return Camera(fx, fy, cx, cy, width, height)


def load_bodies() -> tuple[BodyModel, ...]:
    """The embedded bodies, female and male, which the benchmark shows."""
    return load_body_models(None, ("female", "male"))


class Poser:
    """Meshes and joints of samples in float64, in the camera's axes; the layer is made on first use."""

    @cached_property
    def bodies(self) -> tuple[BodyModel, ...]:
        """The bodies."""
        return load_bodies()

    @cached_property
    def layer(self) -> SparseSMPL:
        """The body layer."""
        return SparseSMPL(self.bodies).to(torch.float64)

    @torch.no_grad()
    def __call__(self, pose: np.ndarray, betas: np.ndarray, gender: np.ndarray) -> tuple[Tensor, Tensor]:
        """Vertices `(B, V, 3)` and joints `(B, 24, 3)`, metres, camera axes, the body's own origin."""
        inputs = (torch.from_numpy(values.astype(np.float64)) for values in (pose, betas))
        vertices, joints = self.layer(*inputs, torch.from_numpy(gender.astype(np.int64)))
        return body_to_camera(vertices), body_to_camera(joints)


def make_definition(num_samples: int = NUM_SAMPLES) -> Definition:
    """The first `num_samples` samples, made anew: embedded test poses, any heading, 1 to 5 m, many cameras.

    A longer table begins with the rows of a shorter one.
    """
    records = EmbeddedSource().records("test", num_samples, seed=_SEED)

    def rng(index: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([_SEED, index, purpose])

    places = [rng(index, _PLACE) for index in range(num_samples)]
    heading = torch.tensor([draw_heading("uniform", each) for each in places], dtype=torch.float64)
    pose = torch.from_numpy(records.pose).double()
    root = rotmat_to_rotvec(rotation_about("z", heading) @ rotvec_to_rotmat(pose[:, :3]))
    turned = torch.cat([root, pose[:, 3:]], -1).numpy().astype("<f2")
    betas, gender = records.betas.astype("<f2"), records.gender.astype("|u1")
    assert set(np.unique(gender)) <= {GENDERS["female"], GENDERS["male"]}

    intrinsics, size = np.empty((num_samples, 4), "<f4"), np.empty((num_samples, 2), "<i2")
    for index in range(num_samples):
        draws = rng(index, _CAMERA)
        factors = [
            math.exp(draws.uniform(math.log(low), math.log(high)))
            for low, high in (FOCAL_FACTORS, PIXEL_FACTORS)
        ]
        camera = varied_camera(KINECT_V2, *factors)
        intrinsics[index] = camera.fx, camera.fy, camera.cx, camera.cy
        size[index] = camera.width, camera.height
    seeds = [rng(index, _NOISE).integers(2**32) for index in range(num_samples)]
    made = {
        "pose": turned,
        "betas": betas,
        "gender": gender,
        "transl": np.zeros((num_samples, 3), "<f4"),
        "intrinsics": intrinsics,
        "size": size,
        "seed": np.array(seeds, "<u4"),
        "kind": records.kinds.astype("<U10"),
    }
    definition, poser = Definition(**made), Poser()
    for start in range(0, num_samples, CHUNK):
        part = slice(start, start + CHUNK)
        vertices, _ = poser(turned[part], betas[part], gender[part])
        for index, mesh in enumerate(vertices.numpy(), start):
            camera, uniform = definition.camera(index), places[index].random(3)
            definition.transl[index] = place(mesh, camera, uniform, DISTANCE_M, MARGIN_PX)
    return definition


def write_definition(definition: Definition, path: Path) -> None:
    """Write a definition as `.npz`, whole or not at all."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer, **{field.name: getattr(definition, field.name) for field in fields(definition)}
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())


def read_definition(path: Path = PATH) -> Definition:
    """A definition from its file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged or holds something else.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"path: no file '{path}'; python -m datamodules.bench --output FILE makes one"
        )
    try:
        arrays = read_arrays(path)
        return Definition(**{name: arrays[name] for name in _FORMS})
    except READ_ERRORS as error:
        raise ValueError(
            f"path: '{path}' is no definition of a benchmark ({reason(error, 500)}); python -m datamodules.bench "
            "makes it again"
        ) from error
