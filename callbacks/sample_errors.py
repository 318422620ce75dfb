"""The errors of every test sample on disk: for paired tests and worst cases."""

from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor

from callbacks.gathering import gather_samples
from ljn.data import Batch
from ljn.metrics.functional import joint_errors_mm


class SampleErrors(Callback):
    """Writes `test_errors.npz` after a test.

    It holds, a row a sample, in the order of their numbers: `sample_id` `(S,)`, `errors_mm` and
    `initial_errors_mm` `(S, 24)`, and `joints`, `pred_joints` and `initial_joints` `(S, 24, 3)` in metres, camera
    frame; of a mesh regressor also `apve_mm` `(S,)`, body frame, `pred_pose` `(S, 72)` and `pred_betas` `(S, 10)`.

    Args:
        directory: Where the file goes.
    """

    def __init__(self, directory: str | Path) -> None:
        self.path = Path(directory) / "test_errors.npz"
        self._batches: list[dict[str, Tensor]] = []

    def on_test_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Batch,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Keep a batch's predictions."""
        kept = {
            "sample_id": batch["sample_id"],
            "joints": batch["joints"],
            "pred_joints": outputs["pred_joints"],
            "initial_joints": batch["initial_joints"],
        }
        kept |= {name: outputs[name] for name in ("pred_pose", "pred_betas") if name in outputs}
        if "apve" in outputs:
            kept["apve_mm"] = outputs["apve"].float()
        self._batches.append({name: value.detach().cpu() for name, value in kept.items()})

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Write the file."""
        batches, self._batches = self._batches, []
        arrays = gather_samples(batches)
        if not arrays or not trainer.is_global_zero:
            return
        arrays["errors_mm"] = joint_errors_mm(arrays["pred_joints"], arrays["joints"]).float()
        arrays["initial_errors_mm"] = joint_errors_mm(arrays["initial_joints"], arrays["joints"]).float()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(self.path, **{name: value.numpy() for name, value in arrays.items()})  # type: ignore[arg-type]
