"""The trained stages as one function: depth, camera and 2D keypoints in, joints and mesh out."""

import logging
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from scipy.spatial import cKDTree

from ljn.body.skeleton import ROOT
from ljn.cloud.observation import Observation, observe, stack_observations
from ljn.geometry.camera import Camera, place_at_root
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotmat_to_rotvec
from ljn.modules.joint_detector import JointDetector
from ljn.modules.mesh_regressor import MeshRegressor
from ljn.pipeline.depth import body_depth
from ljn.pipeline.keypoint_finder import KeypointFinder
from ljn.pipeline.keypoints import MIN_KNOWN, Keypoints, body_keypoints
from ljn.pipeline.prediction import Prediction
from ljn.pipeline.report import Report
from ljn.pipeline.stages import Stage, load_stage
from ljn.refinement import Refiner, chosen_settings, refine, second_look
from ljn.runs.packages import DEFAULT, find_package, stages_of

_LOG = logging.getLogger(__name__)
_SEED = 0  # of the choice of points: the same for every image, so that equal input gives equal output


class ObservedFrame(NamedTuple):
    """One image as the stages take it.

    Attributes:
        depth: `(H, W)` float32, metres; 0 is background.
        detector: The joint detector's observation, with a cloud in any case.
        regressor: The mesh regressor's; None without one.
        confidences: See `Prediction`.
        report: What was found in the input, and done about it.
    """

    depth: np.ndarray
    detector: Observation
    regressor: Observation | None
    confidences: np.ndarray | None
    report: Report


class Pipeline:
    """Finds a person's joints and mesh in a depth image; from the person's 2D keypoints, where the detector takes them.

    Each stage's observation is made as in its training, by the recipe that its checkpoint carries.

    Any camera and image size will do: images much denser than those of the training are thinned (see `observe`). Of
    coarser ones (a small time-of-flight camera, or a distance of over 3 m) the patches that normals are fitted to are
    larger, and the normals smoother, than any in training.

    Args:
        detector: The joint detector.
        regressor: The mesh regressor; None predicts joints alone.
        refine: Whether meshes are fitted to the depth, and how: see `ljn.refinement`. True is "accurate".
        strict: Whether a doubt about the input, which otherwise is logged and goes into the prediction's report, is an
            error.
        finder: Finds the keypoints of images for which none are given; None: the detector does without.

    Raises:
        ValueError: There is no such setting, or no mesh to refine.
    """

    def __init__(
        self,
        detector: Stage,
        regressor: Stage | None = None,
        refine: bool | str | None = None,
        strict: bool = False,
        finder: KeypointFinder | None = None,
    ) -> None:
        self.detector = detector
        self.regressor = regressor
        self.finder = finder
        self.is_strict = strict
        self.refiner: Refiner | None = None
        if (settings := chosen_settings(refine)) is not None:
            if regressor is None:
                raise ValueError(
                    f"refine: {refine!r} fits meshes, and there is no mesh regressor; give one's weights"
                )
            self.refiner = Refiner(regressor.module.body, settings)

    @classmethod
    def load(
        cls,
        detector_ckpt: str | Path,
        mesh_ckpt: str | Path | None = None,
        device: str | torch.device = "cpu",
        body_path: str | Path | None = None,
        refine: bool | str | None = None,
        strict: bool = False,
        keypoint_detector: str | Path | None = None,
    ) -> Self:
        """The pipeline of two checkpoints.

        Args:
            detector_ckpt: A joint detector's checkpoint, or a package's file.
            mesh_ckpt: A mesh regressor's, or a package's file; None predicts joints alone.
            device: Where the networks run.
            body_path: File or folder of the body whose mesh is predicted, for weights trained on bodies that are not
                embedded; None: where it was in the training.
            refine: See the class.
            strict: See the class.
            keypoint_detector: Of images for which no keypoints are given: a keypoint detector's checkpoint, a package's
                file, or the name of one that ships; None: the joint detector does without.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: A checkpoint is damaged or of another stage, or the two belong to different bodies.
        """
        detector, checkpoint = load_stage(detector_ckpt, JointDetector, "detector_ckpt", device)
        finder = None if keypoint_detector is None else KeypointFinder.load(keypoint_detector, device)
        if mesh_ckpt is None:
            return cls(detector, refine=refine, strict=strict, finder=finder)
        regressor, mesh_checkpoint = load_stage(mesh_ckpt, MeshRegressor, "mesh_ckpt", device, body_path)
        if unknown := mesh_checkpoint.unknown_bodies(checkpoint.body_hash.split("-")):
            raise ValueError(
                f"mesh_ckpt: '{mesh_ckpt}' was trained with the bodies {mesh_checkpoint.body_hash}, and {unknown[0]} "
                f"of '{detector_ckpt}' is not among them; joints of one body do not fit another's mesh: give two "
                "checkpoints trained with the same bodies"
            )
        if unknown := mesh_checkpoint.unknown_bodies(regressor.module.body_hashes):
            raise ValueError(
                f"mesh_ckpt: '{mesh_ckpt}' was trained with the bodies {mesh_checkpoint.body_hash}, but the body found "
                f"here is {unknown[0]}; give the training's body file (body.path=FILE, in Python body_path=FILE), or "
                "use the version of this library whose embedded body it was"
            )
        return cls(detector, regressor, refine, strict, finder)

    @classmethod
    def from_pretrained(
        cls,
        name: str | Path = DEFAULT,
        device: str | torch.device = "cpu",
        body_path: str | Path | None = None,
        refine: bool | str | None = None,
        strict: bool = False,
        keypoint_detector: str | Path | None = None,
    ) -> Self:
        """The pipeline of trained weights that ship in one file, a package.

        Args:
            name: Of weights that come with the library; a package's file; or a repository of the Hugging Face hub. See
                `find_package`.
            device: See `load`.
            body_path: See `load`.
            refine: See the class.
            strict: See the class.
            keypoint_detector: See `load`.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: There are no such weights, or see `load`.
            ImportError: They are on the hub, and `huggingface_hub` is missing.
        """
        path = find_package(name, "name")
        mesh = path if "mesh" in stages_of(path, "name") else None
        return cls.load(path, mesh, device, body_path, refine, strict, keypoint_detector)

    @property
    def needs_keypoints(self) -> bool:
        """Whether 2D keypoints have to be given: the joint detector takes them, and nobody finds them."""
        takes = self.detector.module.takes
        return self.finder is None and "initial_joints" in takes and "confidences" not in takes

    def __call__(
        self, depth: Any, camera: Camera, keypoints: Any = None, mask: Any = None, rgb: Any = None
    ) -> Prediction:
        """Predict from one image, or from a batch of one camera's images.

        Args:
            depth: `(H, W)` or `(B, H, W)`: floating-point metres, or integer millimetres; 0 where nothing was
                measured.
            camera: The camera of the images.
            keypoints: See `body_keypoints`; of a batch, one such value for each image. None, or some of them alone, for
                a detector that can do without.
            mask: Of an image, or a batch's: see `person_mask`; None where depth is 0 everywhere else already.
            rgb: Of an image, or a batch's: the registered colour image, see `KeypointFinder`; looked at where keypoints
                are to be found in it.

        Raises:
            ValueError: The input is wrong; the message says how, and of which image of a batch.
        """
        depth = np.asarray(depth)
        if depth.ndim != 3 or depth.shape == (camera.height, camera.width, 1):
            return self.predict([self.observe(depth, camera, keypoints, mask, rgb=rgb)])[0]
        if len(depth) == 0:
            raise ValueError("depth: expected at least one image, got a batch of none")
        none = [None] * len(depth)
        keypoints, masks, colours = (none if each is None else each for each in (keypoints, mask, rgb))
        if not len(depth) == len(keypoints) == len(masks) == len(colours):
            raise ValueError(
                f"depth, keypoints, mask, rgb: expected one of each for every image, got {len(depth)} images, "
                f"{len(keypoints)} keypoints, {len(masks)} masks and {len(colours)} colour images"
            )
        observations = []
        for number, (image, *others, colour) in enumerate(zip(depth, keypoints, masks, colours)):
            try:
                observations.append(self.observe(image, camera, others[0], others[1], rgb=colour))
            except ValueError as error:
                raise ValueError(f"image {number} of the batch: {error}") from error
        return self.predict(observations)

    def observe(
        self,
        depth: Any,
        camera: Camera,
        keypoints: Any = None,
        mask: Any = None,
        report: Report | None = None,
        rgb: Any = None,
    ) -> ObservedFrame:
        """Check one image's input and observe it for each stage; arguments as in a call.

        `report` gets what was found and done; it is the frame's, and its prediction's.
        """
        report = Report(is_strict=self.is_strict) if report is None else report
        misfit = None
        if self.regressor is not None and not self.needs_keypoints:
            misfit = partial(self._misfit_m, camera)
        metres = body_depth(depth, camera, mask, report, misfit)
        named = None
        if keypoints is not None:
            min_known = MIN_KNOWN if self.needs_keypoints else 1
            named = body_keypoints(keypoints, metres, camera, min_known, report)
        elif self.finder is not None:
            named = self.finder(metres, camera, rgb)
            report.note(
                keypoints_found_in=self.finder.sees, keypoints_unsure=int((named.confidences == 0).sum())
            )
        elif self.needs_keypoints:
            raise ValueError(
                "keypoints: expected the person's 2D keypoints, which this joint detector takes, got none; give them, "
                "a keypoint detector that finds them, or a joint detector that can do without: "
                "experiment=detector/cascade"
            )
        for warning in report.warnings:
            _LOG.warning("%s", warning)
        return self.observe_body(metres, camera, named)._replace(report=report)

    def observe_body(
        self,
        depth: np.ndarray,
        camera: Camera,
        keypoints: Keypoints | None = None,
        num_points: int | None = None,
    ) -> ObservedFrame:
        """Observe an image that is known to be right, for each stage.

        Args:
            depth: `(H, W)` float32, metres; 0 is background.
            camera: The camera of this image.
            keypoints: Those of the 24 joints; None for a detector that can do without.
            num_points: Points of the clouds; None: as in each stage's training.
        """
        positions, confidences = (None, None) if keypoints is None else keypoints

        def observed(stage: Stage, takes: set[str]) -> Observation:
            rng, recipe = np.random.default_rng(_SEED), stage.recipe
            if num_points is not None:
                recipe = replace(recipe, num_points=num_points)
            return observe(depth, camera, positions, recipe, takes, rng, confidences)

        takes = {*self.detector.module.takes, "points", *(() if keypoints is None else ("initial_joints",))}
        if self.refiner is not None:
            takes |= set(self.refiner.takes)
        regressor = None
        if self.regressor is not None:
            # Its initial joints are the detector's.
            regressor = observed(self.regressor, set(self.regressor.module.takes) - {"initial_joints"})
        return ObservedFrame(depth, observed(self.detector, takes), regressor, confidences, Report())

    @torch.inference_mode()
    def predict(self, frames: Sequence[ObservedFrame], joints: np.ndarray | None = None) -> Prediction:
        """Run the networks on a batch of at least one frame, all with keypoints or all without.

        `joints` `(B, 24, 3)`, metres, camera frame, stand in place of the detector's, which then does not run.
        """
        if len({frame.confidences is None for frame in frames}) > 1:
            raise ValueError(
                "keypoints: some images of the batch have them and some have not; predict them in two batches"
            )
        detector = self.detector.module
        seen = stack_observations([frame.detector for frame in frames])
        if joints is None:
            found = detector(_on(detector.device, seen))
        else:
            found = torch.from_numpy(joints).to(detector.device, torch.float32)
        arrays = {"points": seen["points"]}
        confidences = [frame.confidences for frame in frames if frame.confidences is not None]
        if confidences:
            arrays |= {name: seen[name] for name in ("initial_joints", "keypoints")}
            arrays["confidences"] = torch.from_numpy(np.stack(confidences))
        if self.regressor is not None:
            made, found = self._meshes(self.regressor.module, frames, seen, found, looks=joints is None)
            arrays |= made
        reports = tuple(frame.report for frame in frames)
        on_cpu: dict[str, Any] = {name: value.cpu().numpy() for name, value in arrays.items()}
        return Prediction(found.cpu().numpy(), **on_cpu, report=reports)

    def _misfit_m(self, camera: Camera, depth: np.ndarray) -> float:
        """How far a depth image lies from the mesh found in it: 90 % of the cloud's points are nearer, metres."""
        plain = copy(self)
        plain.refiner = None  # a fit would draw the mesh to anything
        found = plain.predict([plain.observe_body(depth, camera)])
        assert found.vertices is not None
        return float(np.percentile(cKDTree(found.vertices[0]).query(found.points[0, :, :3])[0], 90))

    def _meshes(
        self,
        regressor: Any,
        frames: Sequence[ObservedFrame],
        detected: dict[str, torch.Tensor],
        joints: torch.Tensor,
        looks: bool,
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """A prediction's arrays of its meshes, and the joints that they began with; `looks`: the detector may again."""
        seen = stack_observations([frame.regressor for frame in frames if frame.regressor is not None])

        def regress(observations: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
            rotmats, betas = (values[-1] for values in regressor(observations))
            return rotmats, betas

        rotmats, betas = regress(_on(regressor.device, seen) | {"initial_joints": joints})
        root = joints[:, ROOT]
        made: dict[str, torch.Tensor] = {}
        if self.refiner is not None:
            detector = self.detector.module
            # A second look at points alone would be at those of the detector's recipe.
            looks = looks and set(regressor.takes) <= {"initial_joints"}
            detect = second_look(detector) if looks else None
            refined, joints = refine(
                *(self.refiner, _on(detector.device, detected), joints, (rotmats, betas)),
                *(detect, regress),
            )
            rotmats, betas, root = refined.rotmats, refined.betas, refined.root
            made = {"is_refined": refined.is_kept, "residual_mm": refined.residual_mm}
        made |= self.meshes(rotmats, betas, root)
        return made, joints

    def meshes(
        self, rotmats: torch.Tensor, betas: torch.Tensor, root: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The arrays of a `Prediction` that are of its mesh, from its parameters, all on the regressor's device.

        Args:
            rotmats: `(B, 24, 3, 3)`, the joints' rotations; the first leads from SMPL's rest frame to body world.
            betas: `(B, 10)`.
            root: `(B, 3)`, the root joint, metres, camera frame.
        """
        assert self.regressor is not None
        layer = self.regressor.module.body
        body = layer.from_rotmats(rotmats, betas)
        return {
            "vertices": place_at_root(body.vertices, body.joints[:, ROOT], root),
            "mesh_joints": place_at_root(body.joints, body.joints[:, ROOT], root),
            "pose": rotmat_to_rotvec(rotmats).flatten(-2),
            "betas": betas,
            "global_orient": rotmat_to_rotvec(CAMERA_FROM_BODY.to(rotmats) @ rotmats[:, 0]),
            # An SMPL layer turns a body about its root, and then moves it.
            "transl": root - body.joints[:, ROOT],
            "faces": layer.faces,
        }


def _on(device: torch.device, tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    return {name: value.to(device) for name, value in tensors.items()}
