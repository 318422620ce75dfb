"""The trained stages as one function: depth, camera and 2D keypoints in, joints and mesh out."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch

from ljn.body.skeleton import ROOT
from ljn.cloud.lifting import lift_keypoints
from ljn.cloud.normals import get_normal_estimator
from ljn.cloud.sampling import sample_cloud
from ljn.geometry.camera import Camera, place_at_root
from ljn.geometry.rotations import rotmat_to_rotvec
from ljn.modules.joint_detector import JointDetector
from ljn.modules.mesh_regressor import MeshRegressor
from ljn.pipeline.depth import body_depth
from ljn.pipeline.keypoints import check_place, smpl_keypoints
from ljn.runs.checkpoints import Checkpoint, load_module

_SEED = 0  # of the choice of points: the same for every image, so that equal input gives equal output


@dataclass(frozen=True)
class Prediction:
    """What is found of one person, or, with a leading dimension B, of a batch; camera frame, metres, float32.

    Attributes:
        joints: `(24, 3)`, the joint detector's.
        initial_joints: `(24, 3)`, the keypoints lifted with the depth image.
        keypoints: `(24, 2)`, those of the SMPL joints, pixels.
        confidences: `(24,)`, the keypoints' own; 0 where a keypoint was filled in.
        points: `(N, 6)`, the detector's cloud: position and normal.
        vertices: `(V, 3)`, the mesh, its root joint at the detector's (Eq. 4.1-4.2).
        pose: `(72,)` axis-angle, radians; the first three turn SMPL's rest frame into body world, as in `Batch`.
        betas: `(10,)`.
        faces: `(F, 3)` int64, vertex indices; of a batch, too.

    Without a mesh regressor, `vertices`, `pose`, `betas` and `faces` are None.
    """

    joints: np.ndarray
    initial_joints: np.ndarray
    keypoints: np.ndarray
    confidences: np.ndarray
    points: np.ndarray
    vertices: np.ndarray | None = None
    pose: np.ndarray | None = None
    betas: np.ndarray | None = None
    faces: np.ndarray | None = None

    def __getitem__(self, index: int) -> Self:
        """One of a batch."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        chosen = {
            name: value if value is None or name == "faces" else value[index]
            for name, value in values.items()
        }
        return type(self)(**chosen)


class Observation(NamedTuple):
    """What the networks take of one image.

    Attributes:
        points: `(N, 6)` float32, position (metres, camera frame) and normal: the joint detector's cloud.
        mesh_points: `(M, 6)`, the mesh regressor's.
        initial_joints: `(24, 3)`, metres, camera frame.
        keypoints: See `Prediction`.
        confidences: See `Prediction`.
    """

    points: np.ndarray
    mesh_points: np.ndarray
    initial_joints: np.ndarray
    keypoints: np.ndarray
    confidences: np.ndarray


@dataclass(frozen=True)
class CloudSettings:
    """How a stage's clouds were made in training.

    Attributes:
        num_points: Points in a cloud.
        normals: See `ljn.cloud.normals.get_normal_estimator`.
        spacing_m: The least distance between the points of neighbouring pixels, metres: of the nearest bodies.
    """

    num_points: int
    normals: str
    spacing_m: float


class Stage(NamedTuple):
    """A trained module, how its clouds are made, and where it comes from.

    Attributes:
        module: A `JointDetector` or a `MeshRegressor`.
        cloud: See `CloudSettings`.
        origin: Path, hash, run and epoch of its checkpoint: for records.
    """

    module: Any
    cloud: CloudSettings
    origin: dict[str, Any]


class Pipeline:
    """Finds a person's joints and mesh in a depth image, given the person's 2D keypoints.

    Clouds are made as in training: back-projected random pixels with the number of points and the normals that each
    checkpoint's configuration names.

    Any camera and image size will do. Normals from a window of the depth image cover a patch of the body whose size
    follows from the pixels' spacing in space, depth over focal length. Where that is less than half of the nearest
    training bodies' (a focal length of twice the training camera's 366 px, or a person twice as near), every second
    pixel, or third, or so on, is used, which brings patches and sensor noise back to what was trained. Where it is
    more (a small time-of-flight camera, or a distance of over 3 m), nothing can be done: patches are larger, and
    normals smoother, than any in training.

    Args:
        detector: The joint detector.
        regressor: The mesh regressor; None predicts joints alone.
    """

    def __init__(self, detector: Stage, regressor: Stage | None = None) -> None:
        self.detector = detector
        self.regressor = regressor

    @classmethod
    def load(
        cls,
        detector_ckpt: str | Path,
        mesh_ckpt: str | Path | None = None,
        device: str | torch.device = "cpu",
    ) -> Self:
        """The pipeline of two checkpoints.

        Args:
            detector_ckpt: A joint detector's.
            mesh_ckpt: A mesh regressor's; None predicts joints alone.
            device: Where the networks run.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: A checkpoint is damaged or of the other stage, or the two belong to different bodies.
        """
        module, checkpoint = load_module(detector_ckpt, JointDetector, "detector_ckpt")
        detector = _stage(module.to(device), checkpoint)
        if mesh_ckpt is None:
            return cls(detector)
        module, mesh_checkpoint = load_module(mesh_ckpt, MeshRegressor, "mesh_ckpt")
        if unknown := mesh_checkpoint.unknown_bodies(checkpoint.body_hash.split("-")):
            raise ValueError(
                f"mesh_ckpt: '{mesh_ckpt}' was trained with the bodies {mesh_checkpoint.body_hash}, and {unknown[0]} "
                f"of '{detector_ckpt}' is not among them; joints of one body do not fit another's mesh: give two "
                "checkpoints trained with the same bodies"
            )
        if unknown := mesh_checkpoint.unknown_bodies(module.body_hashes):
            raise ValueError(
                f"mesh_ckpt: '{mesh_ckpt}' was trained with the bodies {mesh_checkpoint.body_hash}, but the body found "
                f"here is {unknown[0]}; put the training's body file in its place, or use the version of this library "
                "whose embedded body it was"
            )
        return cls(detector, _stage(module.to(device), mesh_checkpoint))

    def __call__(self, depth: Any, camera: Camera, keypoints: Any, mask: Any = None) -> Prediction:
        """Predict from one image, or from a batch of one camera's images.

        Args:
            depth: `(H, W)` or `(B, H, W)`: floating-point metres, or integer millimetres; 0 where nothing was
                measured.
            camera: The camera of the images.
            keypoints: See `smpl_keypoints`; of a batch, one such value for each image.
            mask: `(H, W)` or `(B, H, W)`, not 0 on the person; None where depth is 0 everywhere else already.

        Raises:
            ValueError: The input is wrong; the message says how, and of which image of a batch.
        """
        depth = np.asarray(depth)
        if depth.ndim != 3:
            return self.predict([self.observe(depth, camera, keypoints, mask)])[0]
        if len(depth) == 0:
            raise ValueError("depth: expected at least one image, got a batch of none")
        masks = [None] * len(depth) if mask is None else mask
        if not len(depth) == len(keypoints) == len(masks):
            raise ValueError(
                f"depth, keypoints, mask: expected one of each for every image, got {len(depth)} images, "
                f"{len(keypoints)} keypoints and {len(masks)} masks"
            )
        observations = []
        for number, arguments in enumerate(zip(depth, keypoints, masks)):
            try:
                observations.append(self.observe(arguments[0], camera, *arguments[1:]))
            except ValueError as error:
                raise ValueError(f"image {number} of the batch: {error}") from error
        return self.predict(observations)

    def observe(self, depth: Any, camera: Camera, keypoints: Any, mask: Any = None) -> Observation:
        """Check one image's input and make the clouds and initial joints; arguments as in a call."""
        metres = body_depth(depth, camera, mask)
        found = smpl_keypoints(keypoints)
        check_place(found, metres, camera)
        # As in training, where noise may carry keypoints beyond the image.
        positions = found.positions.clip(0, np.array([camera.width - 1, camera.height - 1], np.float32))
        points = mesh_points = make_cloud(metres, camera, self.detector.cloud)
        if self.regressor is not None and self.regressor.cloud != self.detector.cloud:
            mesh_points = make_cloud(metres, camera, self.regressor.cloud)
        initial_joints = lift_keypoints(positions, metres, camera)
        return Observation(points, mesh_points, initial_joints, positions, found.confidences)

    @torch.inference_mode()
    def predict(self, observations: Sequence[Observation]) -> Prediction:
        """Run the networks on a batch of at least one observation."""
        batch = Observation(*map(np.stack, zip(*observations)))
        detector = self.detector.module
        points, mesh_points, initial_joints = (
            torch.from_numpy(values).to(detector.device)
            for values in (batch.points, batch.mesh_points, batch.initial_joints)
        )
        joints = detector(points, initial_joints)
        inputs = (batch.initial_joints, batch.keypoints, batch.confidences, batch.points)
        if self.regressor is None:
            return Prediction(joints.cpu().numpy(), *inputs)
        regressor = self.regressor.module
        rotmats, betas = (values[-1] for values in regressor(mesh_points, joints))
        body = regressor.body.from_rotmats(rotmats, betas)
        vertices = place_at_root(body.vertices, body.joints[:, ROOT], joints[:, ROOT])
        pose = rotmat_to_rotvec(rotmats).flatten(-2)
        outputs = (vertices, pose, betas, regressor.body.faces)
        return Prediction(joints.cpu().numpy(), *inputs, *(output.cpu().numpy() for output in outputs))


def make_cloud(depth: np.ndarray, camera: Camera, settings: CloudSettings) -> np.ndarray:
    """A cloud with normals, as in training.

    Args:
        depth: `(H, W)` float32, metres; 0 is background.
        camera: The camera of this image.
        settings: See `CloudSettings`.

    Returns:
        `(N, 6)` float32: position, metres, camera frame; normal.
    """
    spacing = float(np.median(depth[depth > 0])) / camera.fx
    depth, camera = _every(max(1, int(settings.spacing_m / spacing)), depth, camera)
    cloud = sample_cloud(depth, camera, settings.num_points, np.random.default_rng(_SEED))
    normals = get_normal_estimator(settings.normals)(cloud, depth, camera)
    return np.concatenate([cloud.points, normals], -1)


def _every(step: int, depth: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Every `step`-th row and column of an image, and the camera that sees just these."""
    thinned = np.ascontiguousarray(depth[::step, ::step])
    height, width = thinned.shape
    return thinned, Camera(
        camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, width, height
    )


def _stage(module: Any, checkpoint: Checkpoint) -> Stage:
    data = checkpoint.config["data"]
    try:
        settings = CloudSettings(
            num_points=data["num_points"],
            normals=data["normals"],
            spacing_m=data["distance_m"][0] / data["camera"]["fx"],
        )
    except KeyError as error:
        raise ValueError(
            f"'{checkpoint.path}': its data's configuration has no {error}, so its clouds cannot be made"
        ) from error
    origin = {
        "path": str(checkpoint.path),
        "hash": checkpoint.file_hash,
        "run": checkpoint.run,
        "epoch": checkpoint.epoch,
        "body_hash": checkpoint.body_hash,
    }
    return Stage(module, settings, origin)
