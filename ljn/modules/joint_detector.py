"""Stage 1 as a LightningModule: training, validation and test of a joint detector."""

from collections.abc import Callable
from typing import Any, ClassVar

from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ljn.body.skeleton import ROOT
from ljn.data import Batch
from ljn.losses import check_loss, joint_loss
from ljn.metrics import JointMetrics
from ljn.modules.base import StageModule
from ljn.nets.detector import Detector
from ljn.nets.yardsticks import Yardstick


class JointDetector(StageModule):
    """A joint detector (`net`: a `Detector`) with its loss (Eq. 3.6), optimizer and metrics; see `StageModule`.

    Args:
        net: The network.
        optimizer: See `StageModule`.
        scheduler: See `StageModule`.
        loss: One of `ljn.losses.LOSSES`.
    """

    stage = "detector"
    metrics = JointMetrics
    net_type: ClassVar[type[nn.Module]] = Detector
    truth = ("joints",)
    stored = ("initial_joints", "pred_joints")
    net: Detector

    def __init__(
        self,
        net: Detector,
        optimizer: Callable[..., Optimizer] | None = None,
        scheduler: Callable[[Optimizer], LRScheduler] | None = None,
        loss: str = "squared",
    ) -> None:
        super().__init__(net, optimizer, scheduler)
        self.kind_of_loss = check_loss(loss)

    @property
    def is_root_relative(self) -> bool:
        """See `StageModule.is_root_relative`."""
        return self.net.is_root_relative

    def loss(self, batch: Batch) -> Tensor:
        """See `StageModule.loss`; root-aligned where the network `is_root_relative`, as its metrics are."""
        estimates, joints = self.net.estimates(*self.observation(batch)), batch["joints"]
        if self.is_root_relative:
            estimates = estimates - estimates[:, :, ROOT, None]
            joints = joints - joints[:, ROOT, None]
        return joint_loss(estimates, joints, self.kind_of_loss)

    def evaluate(self, batch: Batch, metrics: Any) -> dict[str, Tensor]:
        """See `StageModule.evaluate`; predicts `pred_joints` `(B, 24, 3)`, metres, camera frame."""
        pred_joints = self(batch)
        samples = metrics.update(
            pred_joints=pred_joints,
            joints=batch["joints"],
            initial_joints=batch["initial_joints"],
            keypoints=batch["keypoints"],
            true_keypoints=batch["true_keypoints"],
        )
        return {"pred_joints": pred_joints, **samples}


class YardstickDetector(JointDetector):
    """A yardstick, fitted in closed form to the samples of one epoch, with a detector's metrics.

    Args:
        net: The yardstick.
    """

    net_type = Yardstick
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
