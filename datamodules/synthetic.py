"""Depth images of bodies, rendered on the fly: the training data of both stages."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datamodules.batches import BLOCK
from datamodules.placement import check_margin
from datamodules.posing import smallest_camera
from datamodules.rendered import RenderedDataModule
from datamodules.sensor import Sensor
from datamodules.sources import FrameSource, ImageSource, PoseSource
from datamodules.synthesis import SAMPLES_VERSION, DepthSynthesizer, RecordedSynthesizer, SynthesisSettings
from ljn.cloud.lifting import depth_at
from ljn.cloud.normals import get_normal_estimator
from ljn.cloud.observation import ObservationRecipe
from ljn.data import SPLITS, Batch
from ljn.geometry.camera import Camera, back_project, transfer
from ljn.modules.joint_detector import JointDetector
from ljn.modules.keypoint_detector import KeypointDetector
from ljn.pipeline.keypoints import MIN_CONFIDENCE
from ljn.render import get_renderer
from ljn.runs.checkpoints import Checkpoint, load_module


class SyntheticDepthDataModule(RenderedDataModule):
    """Bodies from a pose source, seen by a depth camera; see `RenderedDataModule`.

    Args:
        source: Where poses come from, and of an `ImageSource` depth images, too.
        camera: The depth camera.
        synthesis: How a pose becomes a sample.
        observation: How its depth image is observed.
        num_train: Training samples in an epoch.
        num_val: Validation samples.
        num_test: Test samples.
        batch_size: Samples in a batch; of a run in several processes, in all of theirs together.
        seed: Seed of the training samples' draws and order.
        pool_seed: Seed of the poses and shapes.
        eval_seed: Seed of the validation and test samples' draws.
        cache_dir: Where the fixed sets and the poses are kept.
        body_path: SMPL-format file, or a folder of them; the embedded bodies by default. See
            `load_body_models`.
        detector_ckpt: Checkpoint of a joint detector, whose joints then stand in place of the initial ones; it runs
            on the training device.
        redraw_each_epoch: Whether headings, places, noise and points are drawn anew in every epoch.
        reuse: How many training samples are made of a render, one by default. The first is what it would be without
            the others; each has noise and a choice of points of its own, and every second one is mirrored. An epoch
            has `num_train` samples all the same, from fewer of the records: other ones in each epoch. A render is
            used again 12 batches later, so an epoch of 12 batches uses none twice. Renders are kept by the workers,
            some 0.2 MB each: with 1, 2, 3, 4, 6 or 12 workers none is made twice; other numbers give the same
            samples, but make some anew.
        sensor: What becomes of bodies and images before they are observed; None for `gaussian`, the thesis's noise. See
            `datamodules.sensor`.
        keypoint_ckpt: Checkpoint of a keypoint detector that sees depth images, whose keypoints then stand in place of
            the true ones with noise; it runs on the training device.
        num_workers: Worker processes; 0 renders in the main process.
        prefetch_batches: Batches that each worker keeps ready.
    """

    version = SAMPLES_VERSION

    def __init__(
        self,
        source: PoseSource,
        camera: Camera,
        synthesis: SynthesisSettings,
        observation: ObservationRecipe,
        num_train: int,
        num_val: int,
        num_test: int,
        batch_size: int,
        seed: int,
        pool_seed: int,
        eval_seed: int,
        cache_dir: str | Path,
        body_path: str | Path | None = None,
        detector_ckpt: str | Path | None = None,
        redraw_each_epoch: bool = True,
        reuse: int | None = None,
        sensor: Sensor | None = None,
        keypoint_ckpt: str | Path | None = None,
        num_workers: int = 1,
        prefetch_batches: int = 4,
    ) -> None:
        super().__init__(
            *(
                source,
                num_train,
                num_val,
                num_test,
                batch_size,
                seed,
                pool_seed,
                eval_seed,
                cache_dir,
                body_path,
            ),
            *(redraw_each_epoch, reuse, num_workers, prefetch_batches),
        )
        if isinstance(source, FrameSource):
            raise ValueError(
                f"source: expected poses, or depth images, got '{source.name}', which has frames in colour; use "
                "data=rgb, or of SURREAL data/source=surreal_depth or surreal"
            )
        check_margin(smallest_camera(camera, synthesis), synthesis.margin_px)
        self.camera = camera
        # A detector moves the lifted joints, and found keypoints are lifted.
        is_lifted = detector_ckpt or keypoint_ckpt
        self.synthesis = replace(synthesis, initial_joints="lifted") if is_lifted else synthesis
        self.observation = observation
        self.detector_ckpt = detector_ckpt
        self.keypoint_ckpt = keypoint_ckpt
        self.sensor = sensor

    @property
    def recipe(self) -> ObservationRecipe:
        """See `DataModule`."""
        focal = self.synthesis.densest_focal_px(self.camera)
        return replace(self.observation, spacing_m=self.synthesis.distance_m[0] / focal)

    @property
    def fingerprint(self) -> str:
        """See `DataModule`."""
        networks = [
            each[1].file_hash for each in (self._detector_checkpoint, self._keypoint_checkpoint) if each
        ]
        if not networks:
            return self._samples_fingerprint
        made_of = " ".join([self._samples_fingerprint, *networks])
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    def examples(self, split: str, indices: Sequence[int]) -> tuple[Batch, Tensor]:
        """See `DataModule`."""
        self._check_indices(split, indices)
        batch, depth = self._synthesizer(split).examples([(0, index) for index in indices])
        return self.on_after_batch_transfer(batch, 0), depth

    def describe(self, splits: Sequence[str] = SPLITS) -> dict[str, Any]:
        """See `DataModule`."""
        networks = {}
        for name, path, loaded in (
            ("detector", self.detector_ckpt, self._detector_checkpoint),
            ("keypoint_detector", self.keypoint_ckpt, self._keypoint_checkpoint),
        ):
            networks[name] = None if loaded is None else {"path": str(path), "hash": loaded[1].file_hash}
        return super().describe(splits) | networks

    def prepare_data(self) -> None:
        """See `RenderedDataModule`."""
        super().prepare_data()
        if self._detector_checkpoint is not None:
            checkpoint = self._detector_checkpoint[1]
            if unknown := checkpoint.unknown_bodies(body.hash for body in self.bodies):
                raise ValueError(
                    f"detector_ckpt: '{self.detector_ckpt}' was trained with the bodies {checkpoint.body_hash}, and "
                    f"{unknown[0]} is not among them; a model is only meaningful with its "
                    "bodies"
                )
        if self._keypoint_checkpoint is not None:
            _check_sight(*self._keypoint_checkpoint, self.observation)
        get_renderer(self.synthesis.renderer)
        get_normal_estimator(self.observation.normals)

    @property
    def detector_file(self) -> Path | None:
        """See `DataModule.detector_file`."""
        return None if self.detector_ckpt is None else Path(self.detector_ckpt)

    @cached_property
    def _detector_checkpoint(self) -> tuple[JointDetector, Checkpoint] | None:
        if self.detector_ckpt is None:
            return None
        return load_module(self.detector_ckpt, JointDetector, "detector_ckpt")

    @cached_property
    def _keypoint_checkpoint(self) -> tuple[KeypointDetector, Checkpoint] | None:
        if self.keypoint_ckpt is None:
            return None
        return load_module(self.keypoint_ckpt, KeypointDetector, "keypoint_ckpt")

    @torch.no_grad()
    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Let the networks before the trained one, where there are some, do their part on the device of the batch.

        A keypoint detector's keypoints take the place of the noisy ones, and are lifted; a joint detector moves the
        initial joints.
        """
        if self._keypoint_checkpoint is not None:
            batch = _with_found_keypoints(batch, self._keypoint_checkpoint[0].to(batch["crop"].device))
        if self._detector_checkpoint is None:
            return batch
        lifted = batch["initial_joints"]
        detector = self._detector_checkpoint[0].to(lifted.device)
        return Batch(**{**batch, "initial_joints": detector(batch), "lifted_joints": lifted})

    @property
    def detector(self) -> JointDetector | None:
        """See `DataModule`."""
        return self._detector_checkpoint[0] if self._detector_checkpoint else None

    @property
    def _observed(self) -> frozenset[str]:
        """What is made of an observation: what the network takes, and those before it."""
        networks = [each[0].takes for each in (self._detector_checkpoint, self._keypoint_checkpoint) if each]
        return frozenset((*self.takes, *chain.from_iterable(networks)))

    def _synthesizer(self, split: str) -> DepthSynthesizer:
        is_train = split == "train"
        arguments = (
            self._records_of(split),
            self.bodies,
            self.camera,
            self.synthesis,
            self.observation,
            self._observed,
            (self.seed if is_train else self.eval_seed, SPLITS.index(split)),
            torch.float32 if is_train else torch.float64,
            -(-BLOCK // max(1, self.num_workers)) if is_train and self.reuse > 1 else 0,
            self.sensor,
        )
        if isinstance(self.source, ImageSource):
            return RecordedSynthesizer(self.source, *arguments)
        return DepthSynthesizer(*arguments)

    @property
    def _settings(self) -> str:
        """See `RenderedDataModule`; a detector works on the samples afterwards."""
        settings = f"{self.camera} {self.synthesis} {self.observation} {sorted(self._observed)}"
        return settings if self.sensor is None else f"{settings} {self.sensor}"

    @property
    def starts_fresh(self) -> bool:  # type: ignore[override]
        """See `RenderedDataModule`: a GL context does not survive a fork."""
        return self.synthesis.renderer == "pyrender"


def _check_sight(module: KeypointDetector, checkpoint: Checkpoint, observation: ObservationRecipe) -> None:
    """Raise a `ValueError` unless a keypoint detector sees crops like those of the data."""
    if module.net.sees != "depth" or not isinstance(checkpoint.recipe, ObservationRecipe):
        raise ValueError(
            f"keypoint_ckpt: expected a keypoint detector that sees depth images, which is what this data has, got one "
            f"that sees {module.net.sees} ('{checkpoint.path}'); train experiment=keypoints/cpn_depth"
        )
    if checkpoint.recipe.crop_px != observation.crop_px:
        raise ValueError(
            f"keypoint_ckpt: '{checkpoint.path}' sees crops of {checkpoint.recipe.crop_px} px, those of the data have "
            f"{observation.crop_px}; set data.observation.crop_px={checkpoint.recipe.crop_px}"
        )


def _with_found_keypoints(batch: Batch, module: KeypointDetector) -> Batch:
    """A batch whose keypoints, confidences and initial joints are those that a keypoint detector finds in the crops."""
    found = module(batch)
    confidences = torch.where(found.confidences < MIN_CONFIDENCE, 0.0, found.confidences)
    crops, places = (value.cpu().numpy() for value in (batch["crop"], found.keypoints))
    depth = torch.from_numpy(np.stack([depth_at(*each) for each in zip(places, crops)])).to(found.keypoints)
    made = {
        "keypoints": transfer(found.keypoints, batch["crop_camera"], batch["camera"]),
        "initial_joints": back_project(found.keypoints, depth, batch["crop_camera"]),
    }
    if "confidences" in batch:
        made["confidences"] = confidences
    return Batch(**{**batch, **made})  # type: ignore[typeddict-item]
