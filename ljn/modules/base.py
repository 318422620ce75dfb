"""What the stages' LightningModules share: optimizer wiring, the check of the loss, logging of metrics."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from lightning.pytorch import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ljn.metrics import StageMetrics


class StageModule(LightningModule):
    """Base of the LightningModules: a network with its loss, optimizer and metrics.

    A batch is a mapping of tensors, a row a sample; of what is in it, every stage has `sample_id` `(B,)` alone.

    Args:
        net: The network.
        optimizer: Makes the optimizer from the parameters; None for a module that is not trained here.
        scheduler: Makes the learning-rate scheduler, stepped once an epoch, from the optimizer; None for none.

    Raises:
        ValueError: The network is not of this stage.
    """

    stage: ClassVar[str]
    """What records and tables call the stage, such as `detector`."""
    metrics: ClassVar[type[StageMetrics]]
    """A split's metrics; their keys are what may be monitored."""
    net_type: ClassVar[type[nn.Module]]
    """What `net` must be."""
    truth: ClassVar[tuple[str, ...]]
    """Entries of a batch, stored of every test sample, by which samples of two runs are known to be the same."""
    stored: ClassVar[tuple[str, ...]]
    """Predictions and other entries of a batch that are stored of every test sample too."""

    def __init__(
        self,
        net: nn.Module,
        optimizer: Callable[..., Optimizer] | None = None,
        scheduler: Callable[[Optimizer], LRScheduler] | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(net, self.net_type):
            raise ValueError(
                f"net: a {type(self).__name__} takes a {self.net_type.__name__}, got a {type(net).__name__}; choose "
                "the model and the module of one stage (experiment=..., or module=joint_detector, mesh_regressor)"
            )
        self.net = net
        self._make_optimizer = optimizer
        self._make_scheduler = scheduler
        self.val_metrics = self.metrics(prefix="val/")
        self.test_metrics = self.metrics(prefix="test/")

    @property
    def takes(self) -> tuple[str, ...]:
        """What of an observation the network takes: keys of a batch, in the order of its arguments."""
        return self.net.takes  # type: ignore[return-value]

    def forward(self, batch: Mapping[str, Tensor]) -> Any:
        """What the network makes of a batch, of which it takes `takes`."""
        return self.net(*self.observation(batch))

    def observation(self, batch: Mapping[str, Any]) -> tuple[Tensor, ...]:
        """What the network takes of a batch, in the order of its arguments."""
        return tuple(batch[name] for name in self.takes)

    @property
    def body_hashes(self) -> tuple[str, ...]:
        """Hashes of the bodies that the module itself holds."""
        return ()

    @property
    def is_root_relative(self) -> bool:
        """Whether only the predicted joints' positions beside the root mean something."""
        return False

    def describe(self) -> dict[str, Any]:
        """What a run's record says of its stage, so that a report need not know it."""
        return {
            "stage": self.stage,
            **self.metrics.describe(),
            "truth": list(self.truth),
            "is_root_relative": self.is_root_relative,
        }

    @abstractmethod
    def loss(self, batch: Any) -> Tensor:
        """Scalar loss of a batch."""

    @abstractmethod
    def evaluate(self, batch: Any, metrics: Any) -> dict[str, Tensor]:
        """Update a split's metrics with a batch.

        Returns:
            For callbacks: the predictions, and each sample's value of each metric under its key, `(B,)` float64.
        """

    def configure_optimizers(self) -> OptimizerLRScheduler:
        """The optimizer and, stepped once an epoch, the scheduler."""
        if self._make_optimizer is None:
            return None
        optimizer = self._make_optimizer(self.parameters())
        if self._make_scheduler is None:
            return optimizer
        return {"optimizer": optimizer, "lr_scheduler": self._make_scheduler(optimizer)}

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Loss of a batch."""
        loss = self.loss(batch)
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(
                f"the training loss is {loss.item()} in epoch {self.current_epoch}, batch {batch_idx}; lower the "
                "learning rate, or check the data (samples "
                f"{batch['sample_id'].tolist()})"
            )
        size = len(batch["sample_id"])
        self.log("train/loss", loss, on_step=False, on_epoch=True, batch_size=size, sync_dist=True)
        return loss

    def validation_step(self, batch: Any, batch_idx: int) -> dict[str, Tensor]:
        """See `evaluate`."""
        return self.evaluate(batch, self.val_metrics)

    def on_validation_epoch_end(self) -> None:
        """Log the metrics of the validation set."""
        self._log_metrics(self.val_metrics)

    def test_step(self, batch: Any, batch_idx: int) -> dict[str, Tensor]:
        """See `evaluate`."""
        return self.evaluate(batch, self.test_metrics)

    def on_test_epoch_end(self) -> None:
        """Log the metrics of the test set."""
        self._log_metrics(self.test_metrics)

    def _log_metrics(self, metrics: Any) -> None:
        self.log_dict({name: value.float() for name, value in metrics.compute().items()}, prog_bar=False)
        metrics.reset()
