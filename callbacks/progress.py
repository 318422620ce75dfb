"""Progress on the terminal: loss, validation error and speed."""

import sys
import time
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import TQDMProgressBar
from torch import Tensor


class Progress(TQDMProgressBar):
    """Bars on a terminal, and everywhere one line for each epoch, with a validation metric."""

    def __init__(self, metric: str, refresh_rate: int = 10) -> None:
        super().__init__(refresh_rate=refresh_rate if sys.stdout.isatty() else 0)
        self.metric = metric
        self._samples = 0
        self._started = 0.0
        self._training_s = 0.0
        self._loss: Tensor | None = None

    def on_train_epoch_start(self, trainer: Trainer, *args: Any) -> None:
        """Start the clock."""
        super().on_train_epoch_start(trainer, *args)
        self._samples, self._training_s, self._started = 0, 0.0, time.monotonic()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Count the samples."""
        self._samples += len(batch["sample_id"]) * trainer.world_size
        self._training_s = time.monotonic() - self._started
        self._loss = outputs.get("loss") if isinstance(outputs, dict) else None
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        """What the bar shows beside its own counts."""
        shown = super().get_metrics(trainer, pl_module)
        shown.pop("v_num", None)
        if self._loss is not None:
            shown["loss"] = f"{float(self._loss):.4f}"
        if self.metric in trainer.callback_metrics:
            shown[self.metric] = self._value(trainer, pl_module)
        if self._training_s:
            shown["samples/s"] = round(self._samples / self._training_s)
        return shown

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Print the epoch's line."""
        super().on_train_epoch_end(trainer, pl_module)
        metrics = trainer.callback_metrics
        parts = [f"epoch {trainer.current_epoch + 1}/{trainer.max_epochs}"]
        if "train/loss" in metrics:
            parts.append(f"loss {float(metrics['train/loss']):.4f}")
        if self.metric in metrics:
            parts.append(f"{self.metric} {self._value(trainer, pl_module)}")
        if self._training_s:
            parts.append(f"{self._samples / self._training_s:.0f} samples/s")
        trainer.print("  ".join(parts), flush=True)

    def _value(self, trainer: Trainer, module: Any) -> str:
        """The metric's last value, with its unit."""
        value = f"{float(trainer.callback_metrics[self.metric]):.1f}"
        quantity = module.metrics.table.get(self.metric.partition("/")[2])  # the loss is none
        return f"{value} {quantity.unit}" if quantity else value
