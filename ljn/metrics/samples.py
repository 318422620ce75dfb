"""Metrics over samples as torchmetrics, right under DDP and any split into batches.

Sums are kept in float64, so a result does not depend on the order or the size of the batches.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor
from torchmetrics import Metric, MetricCollection

Goal = Literal["min", "max"]


class SampleMetric(Metric):
    """Base: one number of all samples seen; NaN before the first.

    Args:
        unit: Its unit, such as `"mm"`.
        goal: Which values are better; None for what describes the data, where none is.
    """

    is_differentiable = False
    full_state_update = False
    reduce: ClassVar[Any]
    """What becomes of several values of a sample: a function of a tensor and a dimension."""

    def __init__(self, unit: str, goal: Goal | None = "min") -> None:
        super().__init__()
        self.unit = unit
        self.goal = goal

    @property
    def higher_is_better(self) -> bool | None:  # type: ignore[override]
        """The goal as torchmetrics states it."""
        return None if self.goal is None else self.goal == "max"

    def each(self, values: Tensor) -> Tensor:
        """What a batch's samples, `(B, ...)`, come to one by one: `(B,)`."""
        return values if values.ndim == 1 else type(self).reduce(values.flatten(1), 1)


class SampleMean(SampleMetric):
    """Mean of all values of all samples; see `SampleMetric`."""

    reduce = staticmethod(torch.mean)
    total: Tensor
    count: Tensor

    def __init__(self, unit: str, goal: Goal | None = "min") -> None:
        super().__init__(unit, goal)
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, values: Tensor) -> None:
        """Add a batch: `(B, ...)`, float64."""
        # Out of place: a state that a half-precision trainer has cast is float64 again after this.
        self.total = self.total + values.sum()
        self.count = self.count + values.numel()

    def compute(self) -> Tensor:
        """Return the mean, a float64 scalar."""
        return self.total / self.count


class SampleMax(SampleMetric):
    """Maximum of all values of all samples, NaN after any NaN; see `SampleMetric`."""

    reduce = staticmethod(torch.amax)
    maximum: Tensor

    def __init__(self, unit: str, goal: Goal | None = "min") -> None:
        super().__init__(unit, goal)
        self.add_state("maximum", torch.tensor(-torch.inf, dtype=torch.float64), dist_reduce_fx="max")

    def update(self, values: Tensor) -> None:
        """Add a batch: `(B, ...)`, float64."""
        self.maximum = torch.cat([self.maximum[None], values.flatten()]).max()

    def compute(self) -> Tensor:
        """Return the maximum, a float64 scalar."""
        return self.maximum.where(~self.maximum.isneginf(), torch.nan)


class SampleAP(SampleMetric):
    """COCO's average precision of one prediction for each sample, mean over the thresholds 0.5, 0.55, ..., 0.95, in
    percent; see `SampleMetric`.

    Predictions are ranked by their score; precision is made to fall monotonically and read at 101 recalls.
    """

    results: list[Tensor]

    def __init__(self, unit: str, goal: Goal | None = "max") -> None:
        super().__init__(unit, goal)
        self.add_state("results", [], dist_reduce_fx="cat")

    def each(self, values: Tensor) -> Tensor:
        """A sample's own: the share of the thresholds that its similarity reaches, in percent."""
        return 100 * (values[:, :1] >= _thresholds(values)).double().mean(-1).where(
            ~values[:, 0].isnan(), torch.nan
        )

    def update(self, values: Tensor) -> None:
        """Add a batch: `(B, 2)`, similarity and score, float64."""
        self.results.append(values)

    def compute(self) -> Tensor:
        """Return the average precision, a float64 scalar."""
        results: Any = self.results
        if isinstance(results, list):
            if not results:
                return torch.tensor(torch.nan, dtype=torch.float64)
            results = torch.cat(results)
        if results.isnan().any():
            return torch.tensor(torch.nan, dtype=torch.float64)
        ranked = results[results[:, 1].argsort(descending=True, stable=True), 0]
        hits = (ranked[:, None] >= _thresholds(ranked)).double().cumsum(0)  # (S, T)
        places = torch.arange(1, len(ranked) + 1, dtype=torch.float64, device=ranked.device)[:, None]
        recall, precision = hits / len(ranked), hits / places
        precision = precision.flip(0).cummax(0).values.flip(0)
        wanted = torch.linspace(0, 1, 101, dtype=torch.float64, device=ranked.device)
        place = torch.searchsorted(
            recall.T.contiguous(), wanted.expand(recall.shape[1], -1).contiguous()
        )  # (T, 101)
        read = precision.T.gather(1, place.clamp(max=len(ranked) - 1))
        return 100 * torch.where(place < len(ranked), read, 0.0).mean()


def _thresholds(like: Tensor) -> Tensor:
    return torch.linspace(0.5, 0.95, 10, dtype=torch.float64, device=like.device)


@dataclass(frozen=True)
class Quantity:
    """What a metric is of.

    Attributes:
        formula: Functional form: tensors in, float64 `(B, ...)` out.
        arguments: Names of its tensors.
        unit: See `SampleMetric`.
        goal: See `SampleMetric`.
        reduction: What becomes of all samples' values.
    """

    formula: Callable[..., Tensor]
    arguments: tuple[str, ...]
    unit: str = "mm"
    goal: Goal | None = "min"
    reduction: type[SampleMetric] = SampleMean


class StageMetrics(MetricCollection):
    """Base: every metric of a stage under its key, for one split. A subclass names them in a table.

    Args:
        prefix: Put before every key, such as `"val/"`.
    """

    table: ClassVar[Mapping[str, Quantity]]
    headline: ClassVar[tuple[str, ...]]
    """Keys of what a table of results shows, the one that counts most first."""

    def __init__(self, prefix: str | None = None) -> None:
        super().__init__(
            {key: of.reduction(of.unit, of.goal) for key, of in self.table.items()},
            prefix=prefix,
            # Groups merge metrics whose first batch agrees, as mpjpe and initial_mpjpe do for an untrained
            # network with zero offsets; they would stay merged ever after.
            compute_groups=False,
        )

    @torch.no_grad()
    def update(self, **tensors: Tensor) -> dict[str, Tensor]:  # type: ignore[override]
        """Add a batch, given as the table's tensors by name; returns each sample's value of each metric, `(B,)`."""
        samples = {}
        metrics: Any = self.items(keep_base=True)
        for key, metric in metrics:
            quantity = self.table[key]
            values = quantity.formula(*(tensors[name] for name in quantity.arguments))
            metric.update(values)
            samples[key] = metric.each(values)
        return samples

    @classmethod
    def describe(cls) -> dict[str, Any]:
        """Unit and goal of each metric, and which are the headline ones: goes into records."""
        metrics = {key: {"unit": of.unit, "goal": of.goal} for key, of in cls.table.items()}
        return {"metrics": metrics, "headline": list(cls.headline)}
