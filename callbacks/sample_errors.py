"""Every test sample on disk: its metrics, for paired tests and worst cases, its truth and its prediction."""

from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, Trainer
from torch import Tensor

from callbacks.gathering import gather_samples
from ljn.modules.base import StageModule
from ljn.runs import layout


class SampleErrors(Callback):
    """Writes `test_errors.npz` after a test.

    It holds, a row a sample, in the order of their numbers: `sample_id` `(S,)`, each metric's values `(S,)`, float64,
    under the metric's key, and what the module says is stored beside them (`truth` and `stored` of `StageModule`): of
    both stages, `joints`, `pred_joints` and `initial_joints` `(S, 24, 3)` in metres, camera frame; of a mesh regressor
    also `pred_pose` `(S, 72)` and `pred_betas` `(S, 10)`.
    """

    def __init__(self, directory: str | Path) -> None:
        self.path = Path(directory) / layout.SAMPLES
        self._batches: list[dict[str, Tensor]] = []

    def on_test_batch_end(  # type: ignore[override]
        self, trainer: Trainer, pl_module: StageModule, outputs: Any, batch: Any, *_: int
    ) -> None:
        """Keep what is stored of a batch."""
        names = ("sample_id", *pl_module.truth, *pl_module.stored, *pl_module.metrics.table)
        values = {name: outputs[name] if name in outputs else batch[name] for name in names}
        self._batches.append({name: value.detach().cpu() for name, value in values.items()})

    def on_test_end(self, trainer: Trainer, pl_module: StageModule) -> None:  # type: ignore[override]
        """Write the file."""
        batches, self._batches = self._batches, []
        arrays = gather_samples(batches)
        if not arrays or not trainer.is_global_zero:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(self.path, **{name: value.numpy() for name, value in arrays.items()})  # type: ignore[arg-type]
