"""Colour crops of bodies, rendered on the fly: the training data of 2D joint detectors."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from datamodules.placement import check_margin
from datamodules.posing import smallest_camera
from datamodules.rendered import RenderedDataModule
from datamodules.rgb.backgrounds import Background
from datamodules.rgb.chain import Photography
from datamodules.rgb.synthesis import RgbSettings, RgbSynthesizer
from datamodules.sources import PoseSource
from ljn.cloud.rgb import RgbRecipe
from ljn.data import SPLITS, Batch
from ljn.geometry.camera import Camera

RGB_SAMPLES_VERSION = "rgb 1"
_HELD = ("rgb", "rgb_camera")


class RgbDataModule(RenderedDataModule):
    """Bodies from a pose source, seen by a colour camera; see `RenderedDataModule`.

    A crop's joints are those of its own camera frame: `project(joints, rgb_camera)` are the keypoints in its pixels.
    Crops of the fixed sets show the window of the body, upright; training crops vary. Frames of other makers, such as
    SURREAL's, are a data module of their own, with the same keys in its batches.

    Args:
        source: Where poses come from.
        camera: The colour camera.
        synthesis: How bodies come before it, and how training crops vary.
        recipe: Size of the crops.
        background: What is behind the person.
        num_train: Training samples in an epoch.
        num_val: Validation samples.
        num_test: Test samples.
        batch_size: Samples in a batch; of a run in several processes, in all of theirs together.
        seed: Seed of the training samples' draws and order.
        pool_seed: Seed of the poses and shapes.
        eval_seed: Seed of the validation and test samples' draws.
        cache_dir: Where the fixed sets and the poses are kept.
        body_path: See `RenderedDataModule`.
        redraw_each_epoch: Whether all but pose and shape is drawn anew in every epoch.
        photo: The chain that makes the picture: the person's look, light, camera and mask; see `datamodules.rgb`. None
            for a figure without clothes in plain light, perfectly taken.
        num_workers: Worker processes; 0 renders in the main process.
        prefetch_batches: Batches that each worker keeps ready.
    """

    takes = ("rgb",)
    version = RGB_SAMPLES_VERSION

    def __init__(
        self,
        source: PoseSource,
        camera: Camera,
        synthesis: RgbSettings,
        recipe: RgbRecipe,
        background: Background,
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
        photo: Photography | None = None,
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
            *(redraw_each_epoch, None, num_workers, prefetch_batches),
        )
        check_margin(smallest_camera(camera, synthesis), synthesis.margin_px)
        self.camera = camera
        self.synthesis = synthesis
        self.rgb_recipe = recipe
        self.background = background
        self.photo = photo

    @property
    def recipe(self) -> RgbRecipe:
        """See `DataModule`."""
        return self.rgb_recipe

    def examples(self, split: str, indices: Sequence[int]) -> tuple[Batch, Tensor]:
        """See `DataModule`."""
        self._check_indices(split, indices)
        batch = self._synthesizer(split).batch([(0, index) for index in indices])
        return batch, batch["rgb"]

    def prepare_data(self) -> None:
        """See `RenderedDataModule`."""
        super().prepare_data()
        self.background.check()

    def setup(self, stage: str) -> None:
        """See `RenderedDataModule`."""
        if unknown := set(self.takes) - set(_HELD):
            raise ValueError(
                f"data: colour crops have {', '.join(_HELD)}, but the network takes {', '.join(sorted(unknown))}; use "
                "data=synthetic, or a network that takes rgb"
            )
        super().setup(stage)

    def _synthesizer(self, split: str) -> RgbSynthesizer:
        is_train = split == "train"
        return RgbSynthesizer(
            self._records_of(split),
            self.bodies,
            self.camera,
            self.synthesis if is_train else self.synthesis.without_variation(),
            self.rgb_recipe,
            self.background,
            (self.seed if is_train else self.eval_seed, SPLITS.index(split)),
            torch.float32 if is_train else torch.float64,
            self.photo,
        )

    @property
    def _settings(self) -> str:
        """See `RenderedDataModule`."""
        return f"{self.camera} {self.synthesis.without_variation()} {self.rgb_recipe} {self.background} {self.photo}"
