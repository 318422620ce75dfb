"""Stage 1 as a LightningModule: training, validation and test of a joint detector."""

from collections.abc import Callable

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ljn.data import Batch
from ljn.losses import joint_loss
from ljn.metrics import JointMetrics
from ljn.nets.detector import Detector
from ljn.nets.yardsticks import Yardstick


class JointDetector(LightningModule):
    """A joint detector with its loss (Eq. 3.6), optimizer and metrics.

    Args:
        net: The network: `(points, initial_joints) -> joints`.
        optimizer: Makes the optimizer from the parameters; None for a module that is not trained here.
        scheduler: Makes the learning-rate scheduler, stepped once an epoch, from the optimizer; None for none.
    """

    def __init__(
        self,
        net: Detector,
        optimizer: Callable[..., Optimizer] | None = None,
        scheduler: Callable[[Optimizer], LRScheduler] | None = None,
    ) -> None:
        super().__init__()
        self.net = net
        self._make_optimizer = optimizer
        self._make_scheduler = scheduler
        self.val_metrics = JointMetrics(prefix="val/")
        self.test_metrics = JointMetrics(prefix="test/")

    def forward(self, points: Tensor, initial_joints: Tensor) -> Tensor:
        """Joints `(B, 24, 3)` from a cloud `(B, N, 6)` and initial joints `(B, 24, 3)`; metres, camera frame."""
        return self.net(points, initial_joints)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """The optimizer and, stepped once an epoch, the scheduler."""
        if self._make_optimizer is None:
            return None
        optimizer = self._make_optimizer(self.parameters())
        if self._make_scheduler is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": self._make_scheduler(optimizer)}

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Loss of a batch, m^2."""
        loss = joint_loss(self(batch["points"], batch["initial_joints"]), batch["joints"])
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(
                f"the training loss is {loss.item()} in epoch {self.current_epoch}, batch {batch_idx}; lower the "
                "learning rate, or check the data (samples "
                f"{batch['sample_id'].tolist()})"
            )
        self.log("train/loss", loss, on_step=False, on_epoch=True, batch_size=len(batch["joints"]))
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """Update the metrics; returns the predicted joints for callbacks."""
        return self._evaluate(batch, self.val_metrics)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of the validation set."""
        self._log_metrics(self.val_metrics)

    def test_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """Update the metrics; returns the predicted joints for callbacks."""
        return self._evaluate(batch, self.test_metrics)

    def on_test_epoch_end(self) -> None:
        """Log the metrics of the test set."""
        self._log_metrics(self.test_metrics)

    def _evaluate(self, batch: Batch, metrics: JointMetrics) -> dict[str, Tensor]:
        pred_joints = self(batch["points"], batch["initial_joints"])
        metrics.update(
            pred_joints=pred_joints,
            joints=batch["joints"],
            initial_joints=batch["initial_joints"],
            noisy_keypoints_2d=batch["noisy_keypoints_2d"],
            keypoints_2d=batch["keypoints_2d"],
        )
        return {"pred_joints": pred_joints}

    def _log_metrics(self, metrics: JointMetrics) -> None:
        self.log_dict({name: value.float() for name, value in metrics.compute().items()}, prog_bar=False)
        metrics.reset()


class YardstickDetector(JointDetector):
    """A yardstick, fitted in closed form to the samples of one epoch, with a detector's metrics.

    Args:
        net: The yardstick.
    """

    net: Yardstick

    def __init__(self, net: Yardstick) -> None:
        super().__init__(net)
        self.automatic_optimization = False

    def training_step(self, batch: Batch, batch_idx: int) -> None:  # type: ignore[override]
        """Add a batch to the yardstick's sums."""
        self.net.accumulate(batch["points"], batch["initial_joints"], batch["joints"])

    def on_validation_start(self) -> None:
        """Fit the yardstick to the epoch so far: in training, validation comes at the epoch's end."""
        if self.trainer.state.fn == TrainerFn.FITTING:
            self.net.solve()

    def on_train_epoch_end(self) -> None:
        """Fit the yardstick, also where there is no validation."""
        self.net.solve()
