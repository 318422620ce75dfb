"""Base of the data modules whose samples are rendered: records, seeds, loaders, fixed sets."""

import hashlib
import logging
import math
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, Dataset

from datamodules.batches import (
    ByValue,
    EpochSampler,
    RepeatedBatches,
    SharedBatches,
    check_workers,
    fixed_batches,
)
from datamodules.cache import cached_records, cached_samples
from datamodules.posing import BodySynthesizer, SampleKey
from datamodules.sources import Examinable, PoseRecords, PoseSource
from datamodules.synthesis import concatenate
from ljn.body import BodyModel, load_body_models
from ljn.data import SPLITS, Batch, DataModule, Finding
from ljn.geometry.rotations import rotvec_to_rotmat

_LOG = logging.getLogger(__name__)
_CHUNK = 16


class RenderedDataModule(DataModule):
    """Bodies from a pose source, rendered on the fly.

    Training samples are made in worker processes, anew in every epoch; a sample depends on the seed, the epoch, its
    index and the number of its render's use alone, so a run is the same whatever the number of workers and wherever
    it was resumed. Validation and test sets are fixed: made once (from float64 meshes) and kept in `cache_dir`.

    Args:
        source: Where poses come from.
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
        redraw_each_epoch: Whether all that is drawn of a training sample is drawn anew in every epoch.
        reuse: How many training samples are made of a render, one by default.
        num_workers: Worker processes; 0 renders in the main process.
        prefetch_batches: Batches that each worker keeps ready.
    """

    version: int | str
    """Raised with every change of the samples made of the same records: results are comparable within one only."""
    starts_fresh = False
    """Whether workers start as fresh processes, not as copies of this one."""

    def __init__(
        self,
        source: PoseSource,
        num_train: int,
        num_val: int,
        num_test: int,
        batch_size: int,
        seed: int,
        pool_seed: int,
        eval_seed: int,
        cache_dir: str | Path,
        body_path: str | Path | None = None,
        redraw_each_epoch: bool = True,
        reuse: int | None = None,
        num_workers: int = 1,
        prefetch_batches: int = 4,
    ) -> None:
        super().__init__()
        self.source = source
        self.sizes = {"train": num_train, "val": num_val, "test": num_test}
        for split, size in self.sizes.items():
            if size < 1:
                raise ValueError(f"num_{split}: expected at least 1 sample, got {size}")
        self.reuse = 1 if reuse is None else reuse
        if not isinstance(self.reuse, int) or self.reuse < 1:
            raise ValueError(f"reuse: expected a whole number of 1 or more, got {reuse!r}")
        self.batch_size = batch_size
        self.seed = seed
        self.pool_seed = pool_seed
        self.eval_seed = eval_seed
        self.cache_dir = source.cache_dir = Path(cache_dir)
        self.body_path = body_path
        self.redraw_each_epoch = redraw_each_epoch
        self.num_workers = num_workers
        self.prefetch_batches = prefetch_batches
        self._bodies: tuple[BodyModel, ...] | None = None
        self._records: dict[str, PoseRecords] = {}
        self._train: BodySynthesizer | None = None
        self._fixed: dict[str, FixedSamples] = {}

    @abstractmethod
    def _synthesizer(self, split: str) -> BodySynthesizer:
        """What makes a split's samples."""

    @property
    @abstractmethod
    def _settings(self) -> str:
        """All that the samples of a record and a seed depend on, beside bodies, poses and code."""

    @property
    def bodies(self) -> tuple[BodyModel, ...]:
        """A body for each of the source's genders, read on first use."""
        if self._bodies is None:
            self._bodies = load_body_models(self.body_path, self.source.genders)
        return self._bodies

    @property
    def fingerprint(self) -> str:
        """See `DataModule`."""
        return self._samples_fingerprint

    @property
    def _samples_fingerprint(self) -> str:
        """Hash of the bodies, the source and the version of samples; of no settings."""
        bodies = sorted(body.hash for body in self.bodies)
        made_of = f"{self.version} {bodies} {self.source.name} {self.source.fingerprint}"
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    @property
    def licence(self) -> str:
        """The source's licence; see `DataModule`."""
        return self.source.licence

    def _check_indices(self, split: str, indices: Sequence[int]) -> None:
        """Raise a `ValueError` unless a split has these samples."""
        if not all(0 <= index < self.sizes[split] for index in indices):
            raise ValueError(
                f"examples: the {split} set has {self.sizes[split]} samples, got {list(indices)}; ask for fewer, or "
                f"raise data.num_{split}"
            )

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
            "version": self.version,
            "source_version": self.source.version,
            "fingerprint": self.fingerprint,
            "licence": self.source.licence,
            "sizes": {split: self.sizes[split] for split in splits},
            "motion": {split: dict(self.source.motion(split)) for split in splits},
            "pool": {split: self._records_of(split).hash for split in splits},
            "bodies": {body.gender: body.hash for body in self.bodies},
            "seeds": {"seed": self.seed, "pool_seed": self.pool_seed, "eval_seed": self.eval_seed},
        }

    def examine(self, number: int | None) -> Iterator[Finding]:
        """See `DataModule`: what the source finds."""
        if isinstance(self.source, Examinable):
            yield from self.source.examine(self.bodies, number)

    def prepare_data(self) -> None:
        """Check every file and package that will be needed, before anything expensive starts."""
        self.source.check()
        _ = self.bodies

    def setup(self, stage: str) -> None:
        """Build the sets that a stage (`fit`, `validate` or `test`) needs."""
        if stage == "fit" and self._train is None:
            self._train = self._synthesizer("train")
        needed = {"fit": ["val"], "validate": ["val"], "test": ["test"]}[stage]
        for split in needed:
            if split not in self._fixed:
                self._fixed[split] = FixedSamples(self._fixed_samples(split))

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
        """Hash of everything that a fixed set depends on."""
        seeds = f"{self.pool_seed} {self.eval_seed}"
        made_of = f"{self._samples_fingerprint} {split} {self.sizes[split]} {seeds} {self._settings}"
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
            multiprocessing_context="spawn" if self.starts_fresh and self.num_workers > 0 else None,
            persistent_workers=persistent and self.num_workers > 0,
            prefetch_factor=self.prefetch_batches if self.num_workers > 0 else None,
            worker_init_fn=_one_thread,
            # Not the global one: dropout would depend on the number of workers, and on which fixed sets were there.
            generator=torch.Generator().manual_seed(seed),
        )


class SynthesizedSamples(Dataset):
    """Batches rendered when they are asked for, by their samples' keys."""

    def __init__(self, synthesizer: BodySynthesizer) -> None:
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
