"""Every test sample on disk: its metrics, for paired tests and worst cases, its truth and its prediction."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch import Callback, Trainer
from torch import Tensor

from callbacks.gathering import gather_samples
from ljn.data import DataModule
from ljn.modules.base import StageModule
from ljn.runs import layout


class SampleErrors(Callback):
    """Writes `test_errors.npz` after a test.

    It holds, a row a sample, in the order of their numbers: `sample_id` `(S,)`, each metric's values `(S,)`, float64,
    under the metric's key, and what the module says is stored beside them (`truth` and `stored` of `StageModule`): of
    both stages, `joints`, `pred_joints` and `initial_joints` `(S, 24, 3)` in metres, camera frame; of a mesh regressor
    also `pred_pose` `(S, 72)` and `pred_betas` `(S, 10)`.

    Beside it, `test_groups.csv` has the number of samples and the mean of every metric of each kind of sample that the
    data tells apart (`DataModule.groups`), worst first.
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
        values = {name: value.numpy() for name, value in arrays.items()}
        np.savez_compressed(self.path, **values)  # type: ignore[arg-type]
        data: Any = trainer.datamodule  # type: ignore[attr-defined]
        groups = data.groups("test") if isinstance(data, DataModule) else {}
        metrics = pl_module.metrics
        if lines := group_lines(values, groups, list(metrics.table), metrics.headline[0]):
            with self.path.with_name(layout.GROUPS).open("w", newline="") as file:
                csv.writer(file).writerows(lines)


def group_lines(
    values: dict[str, np.ndarray], groups: dict[str, np.ndarray], metrics: list[str], order: str
) -> list[list[Any]]:
    """A table with a header: of each kind of sample the number, and the mean of each metric; by `order`, highest first.

    Args:
        values: `sample_id` `(S,)` and each metric's values `(S,)`.
        groups: See `DataModule.groups`.
        metrics: The metrics' keys.
        order: One of them.
    """
    if not groups:
        return []
    lines: list[list[Any]] = [["by", "kind", "samples", *metrics]]
    for by, names in groups.items():
        kinds = names[values["sample_id"]]
        rows = []
        for kind in np.unique(kinds):
            chosen = kinds == kind
            means = {name: float(values[name][chosen].mean()) for name in metrics}
            row = [by, str(kind), int(chosen.sum()), *(round(mean, 3) for mean in means.values())]
            rows.append((means[order], row))
        lines += [row for _, row in sorted(rows, key=lambda pair: -pair[0])]
    return lines
