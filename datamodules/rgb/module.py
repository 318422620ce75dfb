"""Colour crops of bodies, rendered on the fly: the training data of 2D joint detectors."""

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from datamodules.placement import check_margin
from datamodules.posing import smallest_camera
from datamodules.rendered import RenderedDataModule
from datamodules.rgb.backgrounds import BACKGROUNDS, Background
from datamodules.rgb.chain import Photography
from datamodules.rgb.frames import FrameSynthesizer
from datamodules.rgb.synthesis import RgbSettings, RgbSynthesizer
from datamodules.sources import FrameSource, ImageSource, PoseSource
from ljn.cloud.rgb import RgbRecipe
from ljn.data import SPLITS, Batch
from ljn.geometry.camera import Camera

_LOG = logging.getLogger(__name__)
RGB_SAMPLES_VERSION = "rgb 1"
_HELD = ("rgb", "rgb_camera")


class RgbDataModule(RenderedDataModule):
    """Bodies from a pose source, seen by a colour camera; see `RenderedDataModule`.

    A crop's joints are those of its own camera frame: `project(joints, rgb_camera)` are the keypoints in its pixels.
    Crops of the fixed sets show the window of the body, upright; training crops vary. Of a source of frames, such as
    SURREAL's, crops are cut from these: its bodies stand where they are, so that the camera and how bodies come before
    it are the source's, and the pictures are taken, so that there is no `photo`.

    Args:
        source: Where poses come from, and of a `FrameSource` pictures, too.
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
        _check_pictures(source, background, photo)
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
        arguments = (
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
        if isinstance(self.source, FrameSource):
            return FrameSynthesizer(self.source, *arguments)
        return RgbSynthesizer(*arguments)

    @property
    def _settings(self) -> str:
        """See `RenderedDataModule`."""
        return f"{self.camera} {self.synthesis.without_variation()} {self.rgb_recipe} {self.background} {self.photo}"


def _check_pictures(source: PoseSource, background: Background, photo: Photography | None) -> None:
    """Raise a `ValueError` where pictures are asked for that a source cannot have; say what has no effect on them."""
    has_frames = isinstance(source, FrameSource)
    if isinstance(source, ImageSource):
        raise ValueError(
            f"source: expected poses, or frames in colour, got '{source.name}', which has depth images; use "
            "data=synthetic, or of SURREAL data/source=surreal_rgb or surreal"
        )
    if has_frames and photo is not None:
        raise ValueError(
            f"photo: expected null with '{source.name}', whose pictures are taken: looks, lights and a camera's faults "
            "are for rendered ones; set data/photo=plain"
        )
    if has_frames:
        _LOG.info(
            "%s: bodies stand where the frames show them; data.camera, and heading, distance_m, margin_px and "
            "focal_factors of data.synthesis, are of no effect",
            source.name,
        )
    if background.kind == "own" and not has_frames:
        raise ValueError(
            f"background.kind: 'own' is what the frames of a source show, and '{source.name}' has none; choose one of "
            f"{', '.join(kind for kind in BACKGROUNDS if kind != 'own')}, or data/source=surreal_rgb"
        )
