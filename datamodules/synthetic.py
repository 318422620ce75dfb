"""Depth images of bodies, rendered on the fly: the training data of both stages."""

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, Dataset

from datamodules.batches import (
    BLOCK,
    ByValue,
    EpochSampler,
    RepeatedBatches,
    SharedBatches,
    check_workers,
    fixed_batches,
)
from datamodules.cache import cached_records, cached_samples
from datamodules.placement import check_margin
from datamodules.sensor import Sensor
from datamodules.sources import PoseRecords, PoseSource
from datamodules.synthesis import SAMPLES_VERSION, DepthSynthesizer, SampleKey, SynthesisSettings, concatenate
from ljn.body import BodyModel, load_body_models
from ljn.cloud.normals import get_normal_estimator
from ljn.cloud.observation import ObservationRecipe
from ljn.data import SPLITS, Batch, DataModule
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import rotvec_to_rotmat
from ljn.modules.joint_detector import JointDetector
from ljn.render import get_renderer
from ljn.runs.checkpoints import Checkpoint, load_module

_LOG = logging.getLogger(__name__)
_CHUNK = 16


class SyntheticDepthDataModule(DataModule):
    """Bodies from a pose source, seen by a depth camera.

    Training samples are made in worker processes, anew in every epoch; a sample depends on the seed, the epoch, its
    index and the number of its render's use alone, so a run is the same whatever the number of workers and wherever
    it was resumed. Validation and test sets are fixed: made once (from float64 meshes) and kept in `cache_dir`.

    Args:
        source: Where poses come from.
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
        num_workers: Worker processes; 0 renders in the main process.
        prefetch_batches: Batches that each worker keeps ready.
    """

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
        num_workers: int = 1,
        prefetch_batches: int = 4,
    ) -> None:
        super().__init__()
        check_margin(synthesis.smallest(camera), synthesis.margin_px)
        self.camera = camera
        # A detector moves the lifted joints.
        self.synthesis = replace(synthesis, initial_joints="lifted") if detector_ckpt else synthesis
        self.observation = observation
        self.detector_ckpt = detector_ckpt
        self.source = source
        self.sizes = {"train": num_train, "val": num_val, "test": num_test}
        for split, size in self.sizes.items():
            if size < 1:
                raise ValueError(f"num_{split}: expected at least 1 sample, got {size}")
        self.reuse = 1 if reuse is None else reuse
        if not isinstance(self.reuse, int) or self.reuse < 1:
            raise ValueError(f"reuse: expected a whole number of 1 or more, got {reuse!r}")
        self.sensor = sensor
        self.batch_size = batch_size
        self.seed = seed
        self.pool_seed = pool_seed
        self.eval_seed = eval_seed
        self.cache_dir = Path(cache_dir)
        self.body_path = body_path
        self.redraw_each_epoch = redraw_each_epoch
        self.num_workers = num_workers
        self.prefetch_batches = prefetch_batches
        self._bodies: tuple[BodyModel, ...] | None = None
        self._records: dict[str, PoseRecords] = {}
        self._train: DepthSynthesizer | None = None
        self._fixed: dict[str, FixedSamples] = {}

    @property
    def bodies(self) -> tuple[BodyModel, ...]:
        """A body for each of the source's genders, read on first use."""
        if self._bodies is None:
            self._bodies = load_body_models(self.body_path, self.source.genders)
        return self._bodies

    @property
    def recipe(self) -> ObservationRecipe:
        """See `DataModule`."""
        focal = self.synthesis.densest_focal_px(self.camera)
        return replace(self.observation, spacing_m=self.synthesis.distance_m[0] / focal)

    @property
    def fingerprint(self) -> str:
        """See `DataModule`."""
        if self._detector_checkpoint is None:
            return self._samples_fingerprint
        made_of = f"{self._samples_fingerprint} {self._detector_checkpoint[1].file_hash}"
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    @property
    def _samples_fingerprint(self) -> str:
        """Hash of what samples are made of before a detector sees them."""
        bodies = sorted(body.hash for body in self.bodies)
        made_of = f"{SAMPLES_VERSION} {bodies} {self.source.name} {self.source.fingerprint}"
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    @property
    def licence(self) -> str:
        """The source's licence; see `DataModule`."""
        return self.source.licence

    def examples(self, split: str, indices: Sequence[int]) -> tuple[Batch, Tensor]:
        """See `DataModule`."""
        if not all(0 <= index < self.sizes[split] for index in indices):
            raise ValueError(
                f"examples: the {split} set has {self.sizes[split]} samples, got {list(indices)}; ask for fewer, or "
                f"raise data.num_{split}"
            )
        batch, depth = self._synthesizer(split).examples([(0, index) for index in indices])
        return self.on_after_batch_transfer(batch, 0), depth

    def groups(self, split: str) -> dict[str, np.ndarray]:
        """See `DataModule`: by `pose` (see `PoseRecords.kinds`) and by `heading` (facing, sideways or away)."""
        records = self._records_of(split)
        poses = self._fixed[split].samples["pose"][:, :3]
        # SMPL's front in the body world, whose x points at the camera.
        towards = rotvec_to_rotmat(poses)[:, 0, 2].numpy()
        bound = math.sqrt(0.5)
        headings = np.select([towards > bound, towards < -bound], ["facing", "away"], "sideways")
        return {"pose": records.kinds, "heading": headings}

    def describe(self, splits: Sequence[str] = SPLITS) -> dict[str, Any]:
        """See `DataModule`."""
        return {
            "source": self.source.name,
            "version": SAMPLES_VERSION,
            "source_version": self.source.version,
            "fingerprint": self.fingerprint,
            "licence": self.source.licence,
            "sizes": {split: self.sizes[split] for split in splits},
            "motion": {split: dict(self.source.motion(split)) for split in splits},
            "pool": {split: self._records_of(split).hash for split in splits},
            "bodies": {body.gender: body.hash for body in self.bodies},
            "detector": None
            if self._detector_checkpoint is None
            else {"path": str(self.detector_ckpt), "hash": self._detector_checkpoint[1].file_hash},
            "seeds": {"seed": self.seed, "pool_seed": self.pool_seed, "eval_seed": self.eval_seed},
        }

    def prepare_data(self) -> None:
        """Check every file and package that will be needed, before anything expensive starts."""
        self.source.check()
        _ = self.bodies
        if self._detector_checkpoint is not None:
            checkpoint = self._detector_checkpoint[1]
            if unknown := checkpoint.unknown_bodies(body.hash for body in self.bodies):
                raise ValueError(
                    f"detector_ckpt: '{self.detector_ckpt}' was trained with the bodies {checkpoint.body_hash}, and "
                    f"{unknown[0]} is not among them; a model is only meaningful with its "
                    "bodies"
                )
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

    @torch.no_grad()
    def on_after_batch_transfer(self, batch: Batch, dataloader_idx: int) -> Batch:
        """Let the detector, where there is one, move the initial joints; on the device of the batch."""
        if self._detector_checkpoint is None:
            return batch
        lifted = batch["initial_joints"]
        detector = self._detector_checkpoint[0].to(lifted.device)
        return Batch(**{**batch, "initial_joints": detector(batch), "lifted_joints": lifted})

    @property
    def detector(self) -> JointDetector | None:
        """See `DataModule`."""
        return self._detector_checkpoint[0] if self._detector_checkpoint else None

    def setup(self, stage: str) -> None:
        """Build the sets that a stage (`fit`, `validate` or `test`) needs."""
        if stage == "fit" and self._train is None:
            self._train = self._synthesizer("train")
        needed = {"fit": ["val"], "validate": ["val"], "test": ["test"]}[stage]
        for split in needed:
            if split not in self._fixed:
                self._fixed[split] = FixedSamples(self._fixed_samples(split))

    @property
    def _observed(self) -> frozenset[str]:
        """What is made of an observation: what the network takes, and the detector before it."""
        detector = () if self._detector_checkpoint is None else self._detector_checkpoint[0].takes
        return frozenset((*self.takes, *detector))

    def _records_of(self, split: str) -> PoseRecords:
        if split not in self._records:
            source, size = self.source, self.sizes[split]

            def make() -> PoseRecords:
                _LOG.info("making %d %s poses", size, split)
                return source.records(split, size, self.pool_seed)

            made_of = f"{source.name} {source.version} {source.fingerprint} {split} {size} {self.pool_seed}"
            key = f"{split}-poses-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"
            self._records[split] = cached_records(self.cache_dir, key, make)
        return self._records[split]

    def _synthesizer(self, split: str) -> DepthSynthesizer:
        is_train = split == "train"
        return DepthSynthesizer(
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

    def train_dataloader(self) -> DataLoader:
        """Samples rendered as they are needed; the last, incomplete batch is dropped."""
        if self._train is None:
            raise RuntimeError("setup('fit') has not been called")
        sampler: Any = EpochSampler(self.sizes["train"], self.seed, self.redraw_each_epoch, self._first_epoch)
        batches: Any = BatchSampler(sampler, self.batch_size, drop_last=len(sampler) >= self.batch_size)
        if self.reuse > 1:
            batches = RepeatedBatches(batches, self.reuse)
        return self._loader(SynthesizedSamples(self._train), SharedBatches(batches, *self._process))

    def val_dataloader(self) -> DataLoader:
        """The fixed validation samples."""
        return self._fixed_loader("val")

    def test_dataloader(self) -> DataLoader:
        """The fixed test samples."""
        return self._fixed_loader("test")

    def _fixed_loader(self, split: str) -> DataLoader:
        samples = self._fixed[split]
        parts = fixed_batches(self.sizes[split], self.batch_size, *self._process)
        return DataLoader(samples, batch_sampler=parts, collate_fn=_as_is)

    @property
    def _process(self) -> tuple[int, int]:
        """This process's number among those of the run, and how many there are."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    @property
    def _first_epoch(self) -> int:
        """The epoch that the trainer begins or resumes with.

        It says so itself only after it has asked for batches, when workers have already begun.
        """
        if not self.trainer:
            return 0
        progress: Any = self.trainer.fit_loop.epoch_progress.current
        return progress.processed

    def fixed_key(self, split: str) -> str:
        """Hash of everything that a fixed set depends on; a detector works on it afterwards."""
        seeds = f"{self.pool_seed} {self.eval_seed}"
        settings = f"{self.camera} {self.synthesis} {self.observation} {sorted(self._observed)}"
        if self.sensor is not None:
            settings += f" {self.sensor}"
        made_of = f"{self._samples_fingerprint} {split} {self.sizes[split]} {seeds} {settings}"
        return f"{split}-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"

    def _fixed_samples(self, split: str) -> dict[str, Tensor]:
        def make() -> dict[str, Tensor]:
            _LOG.info("rendering %d %s samples", self.sizes[split], split)
            synthesizer = self._synthesizer(split)
            # Chunks of one size whatever the batch size: the body's products then round alike.
            keys = [(0, index) for index in range(self.sizes[split])]
            chunks = [keys[start : start + _CHUNK] for start in range(0, len(keys), _CHUNK)]
            batches = self._loader(SynthesizedSamples(synthesizer), chunks, persistent=False)
            return concatenate(batches, len(keys))

        return cached_samples(self.cache_dir, self.fixed_key(split), make)

    @property
    def _uses_gl(self) -> bool:
        return self.synthesis.renderer == "pyrender"

    def _loader(self, samples: Dataset, batches: Any, persistent: bool = True) -> DataLoader:
        if self.num_workers > 0:
            check_workers(self.num_workers)
        # A training's one global draw is a loader's own, which dropout has always come after.
        seed = int(torch.empty((), dtype=torch.int64).random_()) if persistent else 0
        return DataLoader(
            samples,
            batch_sampler=batches,
            collate_fn=ByValue if self.num_workers > 0 else _as_is,
            num_workers=self.num_workers,
            # A GL context does not survive a fork.
            multiprocessing_context="spawn" if self._uses_gl and self.num_workers > 0 else None,
            persistent_workers=persistent and self.num_workers > 0,
            prefetch_factor=self.prefetch_batches if self.num_workers > 0 else None,
            worker_init_fn=_one_thread,
            # Not the global one: dropout would depend on the number of workers, and on which fixed sets were there.
            generator=torch.Generator().manual_seed(seed),
        )


class SynthesizedSamples(Dataset):
    """Batches rendered when they are asked for, by their samples' keys."""

    def __init__(self, synthesizer: DepthSynthesizer) -> None:
        self.synthesizer = synthesizer

    def __len__(self) -> int:
        return len(self.synthesizer.records)

    def __getitems__(self, keys: list[SampleKey]) -> Batch:
        # In the main process, too: another number of threads can round the body's products differently.
        num_threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return self.synthesizer.batch(keys)
        finally:
            torch.set_num_threads(num_threads)


class FixedSamples(Dataset):
    """Batches cut from memory-mapped tensors."""

    def __init__(self, samples: dict[str, Tensor]) -> None:
        self.samples = samples

    def __len__(self) -> int:
        return len(next(iter(self.samples.values())))

    def __getitems__(self, indices: list[int]) -> Batch:
        return cast(Batch, {name: value[indices] for name, value in self.samples.items()})


def _as_is(batch: Any) -> Any:
    return batch


def _one_thread(worker: int) -> None:
    torch.set_num_threads(1)
