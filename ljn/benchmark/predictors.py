"""What is measured: anything that takes frames and gives joints; ours, and how a foreign one comes in.

A predictor is an object with a `name` that is called with frames. What it may say of itself beside, as attributes:

- `reads`: which of `keypoints`, `joints` and `points` of a frame (see `BenchFrame`) it reads; none by default. Axes of
  what is not read are left out.
- `needs_keypoints`: whether it cannot do without keypoints; False by default.
- `is_on_surface`: whether its joints are points of the body's surface, not SMPL's joints; False by default.
- `fingerprint`: text that changes with its results; by default the hash of its configuration and its class's file.
"""

import hashlib
import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ljn.benchmark.frames import BenchFrame
from ljn.body.skeleton import NUM_JOINTS
from ljn.cloud.lifting import lift_keypoints
from ljn.pipeline.keypoints import Keypoints, fill_missing
from ljn.pipeline.person import find_person
from ljn.pipeline.pipeline import Pipeline
from ljn.reading import reason
from ljn.runs.packages import SUFFIX

READS = ("keypoints", "joints", "points")
NOT_READ = "not read"


class Predictor(Protocol):
    """What a benchmark measures."""

    @property
    def name(self) -> str:
        """For tables."""
        ...

    def __call__(self, frames: Sequence[BenchFrame]) -> Any:
        """Joints of a batch of frames, or joints and vertices.

        Returns:
            `(B, 24, 3)`, SMPL's joints, metres, camera frame; or a pair of them and `(B, V, 3)`, vertices of the
            truth's topology (None for none).
        """
        ...


class PipelinePredictor:
    """This library's own pipeline; see `ljn.pipeline.pipeline.Pipeline`.

    Args:
        weights: Name or file of a package; in place of the two checkpoints.
        ckpt_path: A joint detector's checkpoint.
        mesh_ckpt_path: A mesh regressor's; None measures joints alone.
        refine: Whether meshes are fitted to the depth, and how; the joints are then the mesh's.
        name: For tables; None: the weights' name or the detector's run.
        device: Where the networks run.
        body_path: See `Pipeline.load`.
        keypoint_detector: Finds the keypoints of frames that have none; one that sees depth images.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: Of `weights` and `ckpt_path` not one is given, or see `Pipeline.load`.
    """

    def __init__(
        self,
        weights: str | Path | None = None,
        ckpt_path: str | Path | None = None,
        mesh_ckpt_path: str | Path | None = None,
        refine: bool | str | None = None,
        name: str | None = None,
        device: str = "cpu",
        body_path: str | Path | None = None,
        keypoint_detector: str | Path | None = None,
    ) -> None:
        if (weights is None) == (ckpt_path is None):
            raise ValueError(
                f"weights, ckpt_path: expected one of them, got {weights!r} and {ckpt_path!r}; give weights=NAME, or "
                "ckpt_path=DETECTOR.ckpt and, for meshes, mesh_ckpt_path=MESH.ckpt"
            )
        if weights is not None:
            self.pipeline = Pipeline.from_pretrained(
                weights, device, body_path, refine, keypoint_detector=keypoint_detector
            )
            self.name = name or Path(weights).name.removesuffix(SUFFIX)
        elif ckpt_path is not None:
            self.pipeline = Pipeline.load(
                *(ckpt_path, mesh_ckpt_path, device, body_path, refine), keypoint_detector=keypoint_detector
            )
            self.name = name or str(self.pipeline.detector.origin["run"])
        refined = self.pipeline.refiner is not None
        if refined and name is None:
            self.name += " refined" if refine in (True, "accurate") else f" refined ({refine})"
        finder = self.pipeline.finder
        if finder is not None and finder.sees != "depth":
            raise ValueError(
                f"keypoint_detector: '{keypoint_detector}' looks at colours, and the frames have none; give one that "
                "sees depth images"
            )
        if finder is not None and name is None:
            self.name += " with found keypoints"
        stages = [self.pipeline.detector, self.pipeline.regressor, finder.stage if finder else None]
        self.fingerprint = " ".join(
            [
                *(str(stage.origin["hash"]) for stage in stages if stage is not None),
                f"refine {refine or None}",
            ]
        )

    @property
    def needs_keypoints(self) -> bool:
        """Whether the detector cannot do without keypoints."""
        return self.pipeline.needs_keypoints

    @property
    def reads(self) -> set[str]:
        """What of a frame the stages read."""
        detector, regressor = self.pipeline.detector.module, self.pipeline.regressor
        takes = {*detector.takes, *(() if regressor is None else regressor.module.takes)}
        if self.pipeline.refiner is not None:
            takes |= set(self.pipeline.refiner.takes)
        reads = {"points"} & takes
        if {"keypoints", "confidences", "initial_joints"} & set(detector.takes):
            reads.add("keypoints")
        return reads if regressor is None else reads | {"joints"}

    def __call__(self, frames: Sequence[BenchFrame]) -> tuple[np.ndarray, np.ndarray | None]:
        """See `Predictor`."""
        # A batch of the networks has keypoints or has none.
        joints, vertices = np.empty((len(frames), NUM_JOINTS, 3), np.float32), None
        for has in (True, False):
            rows = [row for row, frame in enumerate(frames) if (frame.keypoints is not None) == has]
            if not rows:
                continue
            found_joints, found_vertices = self._predict([frames[row] for row in rows])
            joints[rows] = found_joints
            if found_vertices is not None:
                if vertices is None:
                    vertices = np.empty((len(frames), *found_vertices.shape[1:]), np.float32)
                vertices[rows] = found_vertices
        return joints, vertices

    def _predict(self, frames: Sequence[BenchFrame]) -> tuple[np.ndarray, np.ndarray | None]:
        observed = []
        for frame in frames:
            depth = find_person(frame.depth, frame.camera).depth
            keypoints = _filled(frame.keypoints)
            if keypoints is None and self.pipeline.finder is not None:
                keypoints = self.pipeline.finder(depth, frame.camera)
            observed.append(self.pipeline.observe_body(depth, frame.camera, keypoints, frame.num_points))
        given = [frame.joints for frame in frames if frame.joints is not None]
        found = self.pipeline.predict(observed, np.stack(given) if given else None)
        is_of_mesh = bool(given) or self.pipeline.refiner is not None
        joints = found.mesh_joints if is_of_mesh and found.mesh_joints is not None else found.joints
        return joints, found.vertices


class LiftedKeypoints:
    """The baseline: 2D keypoints with the depth at their pixels, those that are missing filled in before."""

    name = "lifted keypoints"
    reads = ("keypoints",)
    needs_keypoints = True
    is_on_surface = True
    fingerprint = "lifted keypoints 1"

    def __call__(self, frames: Sequence[BenchFrame]) -> np.ndarray:
        """See `Predictor`."""
        lifted = []
        for frame in frames:
            keypoints = _filled(frame.keypoints)
            if keypoints is None:
                raise ValueError("keypoints: expected those of every frame, got none")
            lifted.append(lift_keypoints(keypoints.positions, frame.depth, frame.camera))
        return np.stack(lifted)


def _filled(keypoints: np.ndarray | None) -> Keypoints | None:
    """A frame's keypoints, the missing ones filled in."""
    if keypoints is None:
        return None
    return Keypoints(fill_missing(keypoints[:, :2].astype(np.float64)).astype(np.float32), keypoints[:, 2])


class Found(NamedTuple):
    """What a predictor found in some frames.

    Attributes:
        joints: `(B, 24, 3)` float32, metres, camera frame.
        vertices: `(B, V, 3)` float32, metres, camera frame; None without meshes.
    """

    joints: np.ndarray
    vertices: np.ndarray | None


@dataclass(frozen=True)
class Entrant:
    """A predictor, what it says of itself, and its answers checked."""

    name: str
    predictor: Any
    reads: frozenset[str]
    needs_keypoints: bool
    fingerprint: str
    is_on_surface: bool = False

    def skips(self, reads: str, has_keypoints: bool) -> str:
        """Why a condition is not measured: a few words; "" where it is.

        Args:
            reads: What a predictor has to read for it; "" for nothing.
            has_keypoints: Whether its frames have keypoints.
        """
        if reads and reads not in self.reads:
            return NOT_READ
        if reads == "joints":
            return ""
        if has_keypoints:
            return "" if "keypoints" in self.reads else NOT_READ
        return "needs keypoints" if self.needs_keypoints else ""

    def __call__(self, frames: Sequence[BenchFrame], numbers: Sequence[int]) -> Found:
        """What it finds in the frames of samples of these numbers.

        Raises:
            ValueError: It fails, or gives something else than finite joints of the right shape; the message names the
                first such sample.
        """
        try:
            return self._found(frames)
        except Exception as error:
            # Which of the batch it is, the frames say one by one.
            for frame, number in zip(frames, numbers):
                try:
                    self._found([frame])
                except Exception as single:
                    raise ValueError(
                        f"predictor '{self.name}', sample {number}: {_words(single)}"
                    ) from single
            samples = f"samples {numbers[0]} to {numbers[-1]}"
            raise ValueError(
                f"predictor '{self.name}', {samples}, as a batch though not one by one: {_words(error)}"
            ) from error

    def _found(self, frames: Sequence[BenchFrame]) -> Found:
        answer = self.predictor(frames)
        joints, vertices = answer if isinstance(answer, tuple) else (answer, None)
        expected = (len(frames), NUM_JOINTS, 3)
        joints = _array("joints", joints)
        if joints.shape != expected:
            raise ValueError(
                f"joints: expected an array of {expected} (frames, SMPL's joints, x y z in metres in the camera "
                f"frame), got {joints.shape}"
            )
        if vertices is not None:
            vertices = _array("vertices", vertices)
            if vertices.ndim != 3 or vertices.shape[::2] != expected[::2]:
                raise ValueError(
                    f"vertices: expected an array of ({len(frames)}, V, 3) or None, got {vertices.shape}"
                )
        return Found(joints, vertices)


def _words(error: Exception) -> str:
    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
    return kind + reason(error, 1000)


def _array(name: str, values: Any) -> np.ndarray:
    """Finite numbers as float32."""
    try:
        array = np.asarray(values, np.float32)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name}: expected an array of numbers, got {type(values).__name__}") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: {np.count_nonzero(~np.isfinite(array))} values are NaN or infinite")
    return array


def entrant(predictor: Any, key: str, config: Mapping[str, Any]) -> Entrant:
    """A predictor with what it says of itself.

    Args:
        predictor: The object.
        key: Its name where it has none.
        config: What it was built from, plain values.

    Raises:
        ValueError: It cannot be called, or reads something that there is not.
    """
    name = str(getattr(predictor, "name", None) or key)
    if not callable(predictor):
        raise ValueError(
            f"predictors.{key}: expected an object that is called with frames, got a {type(predictor).__name__}"
        )
    reads = frozenset(getattr(predictor, "reads", ()))
    if unknown := reads - set(READS):
        raise ValueError(
            f"predictors.{key}: reads: expected some of {', '.join(READS)}, got {', '.join(sorted(unknown))}"
        )
    fingerprint = getattr(predictor, "fingerprint", None)
    if fingerprint is None:
        source = inspect.getsourcefile(type(predictor))
        content = Path(source).read_bytes() if source else b""
        made_of = json.dumps(config, sort_keys=True, default=str).encode()
        fingerprint = hashlib.sha256(made_of + content).hexdigest()[:16]
    needs_keypoints = bool(getattr(predictor, "needs_keypoints", False))
    is_on_surface = bool(getattr(predictor, "is_on_surface", False))
    return Entrant(name, predictor, reads, needs_keypoints, str(fingerprint), is_on_surface)
