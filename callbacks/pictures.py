"""Pictures of predicted joints: of fixed validation samples while training, of the extremes after a test."""

import warnings
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from ljn.data import Batch
from ljn.drawing import Sample, draw_samples
from ljn.metrics.functional import mpjpe


def _never_stops(hook: Callable[..., None]) -> Callable[..., None]:
    """A hook of `JointPictures` whose errors, whatever they are, become one warning: the run goes on."""

    @wraps(hook)
    def guarded(self: "JointPictures", *arguments: Any, **keywords: Any) -> None:
        try:
            hook(self, *arguments, **keywords)
        except Exception as error:
            if not self.has_warned:
                warnings.warn(f"no pictures: {type(error).__name__}: {error}", stacklevel=2)
            self.has_warned = True

    return guarded


class JointPictures(Callback):
    """Draws clouds with true (blue) and predicted (red) skeletons, from the front and from the side.

    Files go below `directory`, and to W&B where it is among the loggers. A picture that cannot be drawn warns
    once and never stops a run.

    Args:
        directory: Where pictures go.
        num_samples: Validation samples (the first ones) and test samples of each kind to draw.
        every_n_epochs: Epochs between two validation pictures.
    """

    def __init__(self, directory: str | Path, num_samples: int = 4, every_n_epochs: int = 5) -> None:
        self.directory = Path(directory)
        self.num_samples = num_samples
        self.every_n_epochs = every_n_epochs
        self.has_warned = False
        self._validation: list[Sample] = []
        self._test_joints: list[tuple[Tensor, Tensor]] = []

    @_never_stops
    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the first samples."""
        if trainer.state.fn != TrainerFn.FITTING or not self._is_due(trainer):
            return
        for row in range(min(self.num_samples - len(self._validation), len(batch["joints"]))):
            error = float(mpjpe(outputs["pred_joints"][row], batch["joints"][row]))
            self._validation.append(
                _sample(
                    batch,
                    outputs["pred_joints"],
                    row,
                    f"sample {int(batch['sample_id'][row])}: {error:.0f} mm",
                )
            )

    @_never_stops
    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw them."""
        samples, self._validation = self._validation, []
        if samples:
            self._save(trainer, samples, "val/samples", f"val_epoch_{trainer.current_epoch + 1:03d}")

    @_never_stops
    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep the joints of every sample."""
        self._test_joints.append((outputs["pred_joints"].detach().cpu(), batch["joints"].cpu()))

    @_never_stops
    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the best, the median and the worst samples on a page."""
        kept, self._test_joints = self._test_joints, []
        if not kept:
            return
        pred_joints = torch.cat([pred for pred, _ in kept])
        errors = mpjpe(pred_joints, torch.cat([joints for _, joints in kept]))
        order = errors.nan_to_num(nan=torch.inf).argsort().tolist()
        number = min(self.num_samples, len(order))
        middle = (len(order) - number) // 2
        kinds = {"best": order[:number], "median": order[middle : middle + number], "worst": order[-number:]}
        batch_size = len(kept[0][0])
        needed = {index // batch_size for indices in kinds.values() for index in indices}
        points: dict[int, Tensor] = {}
        for batch_idx, batch in enumerate(trainer.test_dataloaders or []):
            if batch_idx in needed:
                points |= {batch_idx * batch_size + row: value for row, value in enumerate(batch["points"])}
            if batch_idx >= max(needed):
                break
        joints = torch.cat([joints for _, joints in kept])
        samples = [
            Sample(
                points[index][:, :3].numpy(),
                joints[index].numpy(),
                pred_joints[index].numpy(),
                f"{kind}: {float(errors[index]):.0f} mm",
            )
            for kind, indices in kinds.items()
            for index in indices
        ]
        self._save(trainer, samples, "test/extremes", "test_best_median_worst")

    def _is_due(self, trainer: Trainer) -> bool:
        epoch = trainer.current_epoch + 1
        return epoch % self.every_n_epochs == 0 or epoch in (1, trainer.max_epochs)

    def _save(self, trainer: Trainer, samples: list[Sample], key: str, name: str) -> None:
        figure = draw_samples(samples, self.num_samples)
        self.directory.mkdir(parents=True, exist_ok=True)
        path = self.directory / f"{name}.png"
        figure.savefig(path)
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                logger.log_image(key, [str(path)])


def _sample(batch: Batch, pred_joints: Tensor, row: int, title: str) -> Sample:
    tensors = (batch["points"][row, :, :3], batch["joints"][row], pred_joints[row])
    points, joints, predicted = (tensor.detach().cpu().numpy() for tensor in tensors)
    return Sample(points, joints, predicted, title)
