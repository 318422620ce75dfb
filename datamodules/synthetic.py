"""Depth images of bodies, rendered on the fly: the training data of both stages."""

import hashlib
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor
from torch.utils.data import BatchSampler, DataLoader, Dataset, Sampler

from datamodules.cache import cached_samples
from datamodules.sources import SPLITS, PoseSource
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings, concatenate
from ljn.body import BodyModel, load_body_model
from ljn.cloud.normals import get_normal_estimator
from ljn.data import Batch, BodyDataModule
from ljn.geometry.camera import Camera
from ljn.render import get_renderer

_LOG = logging.getLogger(__name__)
# Raise it when the same settings begin to give other samples: cached sets of before are then left alone.
_SAMPLES_VERSION = 2
_CHUNK = 16


class SyntheticDepthDataModule(BodyDataModule):
    """Bodies from a pose source, seen by a depth camera.

    Training samples are made in worker processes, anew in every epoch; a sample depends on the seed, the epoch
    and its index alone, so a run is the same whatever the number of workers and wherever it was resumed.
    Validation and test sets are fixed: made once (from float64 meshes) and kept in `cache_dir`.

    Args:
        source: Where poses come from.
        camera: The depth camera.
        num_points: Points in a cloud.
        num_train: Training samples in an epoch.
        num_val: Validation samples.
        num_test: Test samples.
        batch_size: Samples in a batch.
        seed: Seed of the training samples' draws and order.
        pool_seed: Seed of the poses and shapes.
        eval_seed: Seed of the validation and test samples' draws.
        cache_dir: Where the fixed sets are kept.
        body_path: SMPL-format file; the embedded body by default.
        body_gender: Which embedded body, or which gender the file holds.
        redraw_each_epoch: Whether headings, places, noise and points are drawn anew in every epoch.
        num_workers: Worker processes; 0 renders in the main process.
        prefetch_batches: Batches that each worker keeps ready.
        heading: See `datamodules.placement.draw_heading`.
        distance_m: Range of the depth of the body's centre, metres.
        margin_px: Clear border around the body, pixels.
        depth_noise_m: Standard deviation of the depth noise, metres.
        keypoint_noise_px: Standard deviation of the keypoints' noise, pixels.
        renderer: See `ljn.render.get_renderer`.
        normals: `window` or `open3d`.
    """

    def __init__(
        self,
        source: PoseSource,
        camera: Camera,
        num_points: int,
        num_train: int,
        num_val: int,
        num_test: int,
        batch_size: int,
        seed: int,
        pool_seed: int,
        eval_seed: int,
        cache_dir: str | Path,
        body_path: str | Path | None = None,
        body_gender: str = "neutral",
        redraw_each_epoch: bool = True,
        num_workers: int = 1,
        prefetch_batches: int = 4,
        heading: str = "histogram",
        distance_m: Sequence[float] = (1.5, 3.0),
        margin_px: float = 8.0,
        depth_noise_m: float = 0.001,
        keypoint_noise_px: float = 10.0,
        renderer: str = "auto",
        normals: str = "window",
    ) -> None:
        super().__init__()
        self.settings = SynthesisSettings(
            camera=camera,
            num_points=num_points,
            heading=heading,
            distance_m=_pair("distance_m", distance_m),
            margin_px=float(margin_px),
            depth_noise_m=float(depth_noise_m),
            keypoint_noise_px=float(keypoint_noise_px),
            renderer=renderer,
            normals=normals,
        )
        self.source = source
        self.sizes = {"train": num_train, "val": num_val, "test": num_test}
        for split, size in self.sizes.items():
            if size < 1:
                raise ValueError(f"num_{split}: expected at least 1 sample, got {size}")
        self.batch_size = batch_size
        self.seed = seed
        self.pool_seed = pool_seed
        self.eval_seed = eval_seed
        self.cache_dir = Path(cache_dir)
        self.body_path = body_path
        self.body_gender = body_gender
        self.redraw_each_epoch = redraw_each_epoch
        self.num_workers = num_workers
        self.prefetch_batches = prefetch_batches
        self._body: BodyModel | None = None
        self._train: DepthSynthesizer | None = None
        self._fixed: dict[str, Dataset] = {}

    @property
    def body(self) -> BodyModel:
        """The body, read on first use."""
        if self._body is None:
            self._body = load_body_model(self.body_path, self.body_gender)
        return self._body

    @property
    def fingerprint(self) -> str:
        """See `BodyDataModule`."""
        made_of = f"{_SAMPLES_VERSION} {self.body.hash} {self.source.name} {self.source.fingerprint}"
        return hashlib.sha256(made_of.encode()).hexdigest()[:16]

    @property
    def licence(self) -> str:
        """The source's licence; see `BodyDataModule`."""
        return self.source.licence

    def examples(self, num_samples: int) -> tuple[Batch, Tensor]:
        """See `BodyDataModule`."""
        return self._make_train_synthesizer(num_samples).examples(
            [(0, index) for index in range(num_samples)]
        )

    def describe(self) -> dict[str, Any]:
        """See `BodyDataModule`."""
        return {
            "source": self.source.name,
            "fingerprint": self.fingerprint,
            "licence": self.source.licence,
            "sizes": self.sizes,
            "body": {"hash": self.body.hash, "gender": self.body.gender},
            "seeds": {"seed": self.seed, "pool_seed": self.pool_seed, "eval_seed": self.eval_seed},
        }

    def prepare_data(self) -> None:
        """Check every file and package that will be needed, before anything expensive starts."""
        self.source.check()
        _ = self.body
        get_renderer(self.settings.renderer)
        get_normal_estimator(self.settings.normals)

    def setup(self, stage: str) -> None:
        """Build the sets that a stage (`fit`, `validate` or `test`) needs."""
        if stage == "fit" and self._train is None:
            self._train = self._make_train_synthesizer(self.sizes["train"])
        needed = {"fit": ["val"], "validate": ["val"], "test": ["test"]}[stage]
        for split in needed:
            if split not in self._fixed:
                self._fixed[split] = FixedSamples(self._fixed_samples(split))

    def _make_train_synthesizer(self, num_records: int) -> DepthSynthesizer:
        records = self.source.records("train", num_records, self.pool_seed)
        return DepthSynthesizer(records, self.body, self.settings, (self.seed, SPLITS.index("train")))

    def train_dataloader(self) -> DataLoader:
        """Samples rendered as they are needed; the last, incomplete batch is dropped."""
        if self._train is None:
            raise RuntimeError("setup('fit') has not been called")
        sampler: Any = EpochSampler(self.sizes["train"], self.seed, self.redraw_each_epoch)
        batches = BatchSampler(sampler, self.batch_size, drop_last=len(sampler) >= self.batch_size)
        return self._loader(SynthesizedSamples(self._train), batches)

    def val_dataloader(self) -> DataLoader:
        """The fixed validation samples."""
        return DataLoader(self._fixed["val"], self.batch_size, collate_fn=_as_is)

    def test_dataloader(self) -> DataLoader:
        """The fixed test samples."""
        return DataLoader(self._fixed["test"], self.batch_size, collate_fn=_as_is)

    def fixed_key(self, split: str) -> str:
        """Hash of everything that a fixed set depends on."""
        made_of = f"{self.fingerprint} {split} {self.sizes[split]} {self.pool_seed} {self.eval_seed} {self.settings}"
        return f"{split}-{hashlib.sha256(made_of.encode()).hexdigest()[:16]}"

    def _fixed_samples(self, split: str) -> dict[str, Tensor]:
        def make() -> dict[str, Tensor]:
            _LOG.info("rendering %d %s samples", self.sizes[split], split)
            records = self.source.records(split, self.sizes[split], self.pool_seed)
            synthesizer = DepthSynthesizer(
                records, self.body, self.settings, (self.eval_seed, SPLITS.index(split)), torch.float64
            )
            # Chunks of one size whatever the batch size: the body's products then round alike.
            keys = [(0, index) for index in range(len(records))]
            chunks = [keys[start : start + _CHUNK] for start in range(0, len(keys), _CHUNK)]
            batches = self._loader(SynthesizedSamples(synthesizer), chunks, persistent=False)
            return concatenate(batches, len(records))

        return cached_samples(self.cache_dir, self.fixed_key(split), make)

    @property
    def _uses_gl(self) -> bool:
        return self.settings.renderer == "pyrender"

    def _loader(self, samples: Dataset, batches: Any, persistent: bool = True) -> DataLoader:
        return DataLoader(
            samples,
            batch_sampler=batches,
            collate_fn=_as_is,
            num_workers=self.num_workers,
            # A GL context does not survive a fork.
            multiprocessing_context="spawn" if self._uses_gl and self.num_workers > 0 else None,
            persistent_workers=persistent and self.num_workers > 0,
            prefetch_factor=self.prefetch_batches if self.num_workers > 0 else None,
            worker_init_fn=_one_thread,
        )


class SynthesizedSamples(Dataset):
    """Batches rendered when they are asked for, by their samples' keys (epoch, index)."""

    def __init__(self, synthesizer: DepthSynthesizer) -> None:
        self.synthesizer = synthesizer

    def __len__(self) -> int:
        return len(self.synthesizer.records)

    def __getitems__(self, keys: list[tuple[int, int]]) -> Batch:
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


class EpochSampler(Sampler[tuple[int, int]]):
    """Indices in an order drawn anew for each epoch, each with the epoch's number beside it.

    The number travels with the index, so that workers that live on through epochs draw anew without being told.
    """

    def __init__(self, num_samples: int, seed: int, redraws: bool = True) -> None:
        self.num_samples = num_samples
        self.seed = seed
        self.redraws = redraws
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Called by the trainer before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.num_samples

    def __iter__(self) -> Iterator[tuple[int, int]]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
        epoch = self.epoch if self.redraws else 0
        for index in torch.randperm(self.num_samples, generator=generator).tolist():
            yield epoch, index


def _pair(name: str, values: Sequence[float]) -> tuple[float, float]:
    if not isinstance(values, Sequence) or len(values) != 2:
        raise ValueError(f"{name}: expected two numbers, nearest and farthest, got {values!r}")
    return float(values[0]), float(values[1])


def _as_is(batch: Any) -> Any:
    return batch


def _one_thread(worker: int) -> None:
    torch.set_num_threads(1)
