"""The joint detector's metrics (section 3.7.1) as torchmetrics, right under DDP and any split into batches.

Sums are kept in float64, so a result does not hang on the order or the size of the batches.
"""

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor
from torchmetrics import Metric, MetricCollection

from ljn.metrics import functional


class SampleMean(Metric):
    """Mean of a functional form over all samples seen; NaN before the first.

    A subclass names its `formula`, whose arguments are those of `update`.
    """

    is_differentiable = False
    higher_is_better: bool | None = False
    full_state_update = False
    formula: ClassVar[Callable[..., Tensor]]
    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, *tensors: Tensor) -> None:
        """Add a batch, given as the arguments of the functional form."""
        values = self.formula(*tensors)
        # Out of place: a state that a half-precision trainer has cast is float64 again after this.
        self.total = self.total + values.sum()
        self.count = self.count + values.numel()

    def compute(self) -> Tensor:
        """Return the mean, a float64 scalar in the unit of the functional form."""
        return self.total / self.count


class SampleMax(Metric):
    """Maximum of a functional form over all samples seen; NaN before the first, and after any NaN.

    A subclass names its `formula`, whose arguments are those of `update`.
    """

    is_differentiable = False
    higher_is_better: bool | None = False
    full_state_update = False
    formula: ClassVar[Callable[..., Tensor]]
    maximum: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("maximum", torch.tensor(-torch.inf, dtype=torch.float64), dist_reduce_fx="max")

    def update(self, *tensors: Tensor) -> None:
        """Add a batch, given as the arguments of the functional form."""
        values = self.formula(*tensors)
        self.maximum = torch.cat([self.maximum[None], values.flatten()]).max()

    def compute(self) -> Tensor:
        """Return the maximum, a float64 scalar in the unit of the functional form."""
        return self.maximum.where(~self.maximum.isneginf(), torch.nan)


class MPJPE(SampleMean):
    """Mean error over all joints, mm; see `functional.mpjpe`."""

    formula = staticmethod(functional.mpjpe)


class MPJPEEq38(SampleMean):
    """Eq. 3.8 to the letter, mm; see `functional.mpjpe_eq38`."""

    formula = staticmethod(functional.mpjpe_eq38)


class RootAlignedMPJPE(SampleMean):
    """Mean error with the roots made to coincide, mm; see `functional.mpjpe_root_aligned`."""

    formula = staticmethod(functional.mpjpe_root_aligned)


class ProcrustesMPJPE(SampleMean):
    """Mean error after the best similarity transform, mm; see `functional.mpjpe_procrustes`."""

    formula = staticmethod(functional.mpjpe_procrustes)


class PCKh(SampleMean):
    """PCKh@0.5, %; see `functional.pckh`."""

    higher_is_better = True
    formula = staticmethod(functional.pckh)


class RootAlignedPCKh(SampleMean):
    """PCKh@0.5 with the roots made to coincide, %; see `functional.pckh_root_aligned`."""

    higher_is_better = True
    formula = staticmethod(functional.pckh_root_aligned)


class PCKhThreshold(SampleMean):
    """Mean threshold of PCKh@0.5, mm, from the true joints alone; see `functional.pckh_threshold_mm`."""

    higher_is_better = None
    formula = staticmethod(functional.pckh_threshold_mm)


class MeanKeypointDistance(SampleMean):
    """Mean distance of the noisy 2D keypoints from the clean, px; see `functional.keypoint_distances_px`."""

    higher_is_better = None
    formula = staticmethod(functional.keypoint_distances_px)


class MaxKeypointDistance(SampleMax):
    """Maximum distance of a noisy 2D keypoint from the clean, px; see `functional.keypoint_distances_px`."""

    higher_is_better = None
    formula = staticmethod(functional.keypoint_distances_px)


class JointMetrics(MetricCollection):
    """Every metric of the joint detector under its key, for one split.

    | key                        | unit | of                             |
    |----------------------------|------|--------------------------------|
    | `mpjpe`                    | mm   | predicted joints, camera frame |
    | `mpjpe_eq38`               | mm   | predicted joints, camera frame |
    | `mpjpe_root_aligned`       | mm   | predicted joints               |
    | `mpjpe_procrustes`         | mm   | predicted joints               |
    | `pckh`                     | %    | predicted joints, camera frame |
    | `pckh_root_aligned`        | %    | predicted joints               |
    | `pckh_threshold_mm`        | mm   | true joints                    |
    | `initial_mpjpe`            | mm   | initial joints, camera frame   |
    | `initial_mean_distance_px` | px   | noisy keypoints                |
    | `initial_max_distance_px`  | px   | noisy keypoints                |

    Args:
        prefix: put before every key, such as `"val/"`.
    """

    def __init__(self, prefix: str | None = None) -> None:
        super().__init__(
            {
                "mpjpe": MPJPE(),
                "mpjpe_eq38": MPJPEEq38(),
                "mpjpe_root_aligned": RootAlignedMPJPE(),
                "mpjpe_procrustes": ProcrustesMPJPE(),
                "pckh": PCKh(),
                "pckh_root_aligned": RootAlignedPCKh(),
                "pckh_threshold_mm": PCKhThreshold(),
                "initial_mpjpe": MPJPE(),
                "initial_mean_distance_px": MeanKeypointDistance(),
                "initial_max_distance_px": MaxKeypointDistance(),
            },
            prefix=prefix,
            # Groups merge metrics whose first batch agrees, as mpjpe and initial_mpjpe do for an untrained
            # network with zero offsets; they would stay merged ever after.
            compute_groups=False,
        )

    def update(  # type: ignore[override]
        self,
        pred_joints: Tensor,
        joints: Tensor,
        initial_joints: Tensor,
        keypoints: Tensor,
        true_keypoints: Tensor,
    ) -> None:
        """Add a batch.

        Args:
            pred_joints: `(B, 24, 3)`, metres, camera frame.
            joints: `(B, 24, 3)`, metres, camera frame, the truth.
            initial_joints: `(B, 24, 3)`, metres, camera frame.
            keypoints: `(B, 24, 2)`, pixels.
            true_keypoints: `(B, 24, 2)`, pixels, the truth.
        """
        others: dict[str, tuple[Tensor, ...]] = {
            "pckh_threshold_mm": (joints,),
            "initial_mpjpe": (initial_joints, joints),
            "initial_mean_distance_px": (keypoints, true_keypoints),
            "initial_max_distance_px": (keypoints, true_keypoints),
        }
        for key, metric in self.items(keep_base=True):
            metric.update(*others.get(key, (pred_joints, joints)))
