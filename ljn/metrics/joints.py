"""The joint detector's metrics (section 3.7.1)."""

from typing import ClassVar

from torch import Tensor

from ljn.metrics import functional
from ljn.metrics.samples import Quantity, SampleMax, StageMetrics

_PREDICTED = ("pred_joints", "joints")
_KEYPOINTS = ("keypoints", "true_keypoints")


class JointMetrics(StageMetrics):
    """Every metric of the joint detector under its key, for one split; see `StageMetrics`.

    Those of the predicted and of the initial joints are in the camera frame; `initial_*_px` are of the noisy keypoints.
    """

    table: ClassVar = {
        "mpjpe": Quantity(functional.mpjpe, _PREDICTED),
        "mpjpe_eq38": Quantity(functional.mpjpe_eq38, _PREDICTED),
        "mpjpe_root_aligned": Quantity(functional.mpjpe_root_aligned, _PREDICTED),
        "mpjpe_procrustes": Quantity(functional.mpjpe_procrustes, _PREDICTED),
        "pckh": Quantity(functional.pckh, _PREDICTED, "%", "max"),
        "pckh_root_aligned": Quantity(functional.pckh_root_aligned, _PREDICTED, "%", "max"),
        "exchanged": Quantity(functional.exchanged, _PREDICTED, "%"),
        "pckh_threshold_mm": Quantity(functional.pckh_threshold_mm, ("joints",), goal=None),
        "initial_mpjpe": Quantity(functional.mpjpe, ("initial_joints", "joints")),
        "initial_mean_distance_px": Quantity(functional.keypoint_distances_px, _KEYPOINTS, "px", None),
        "initial_max_distance_px": Quantity(
            functional.keypoint_distances_px, _KEYPOINTS, "px", None, SampleMax
        ),
    }
    headline = ("mpjpe", "pckh")

    def update(  # type: ignore[override]
        self,
        pred_joints: Tensor,
        joints: Tensor,
        initial_joints: Tensor,
        keypoints: Tensor,
        true_keypoints: Tensor,
    ) -> dict[str, Tensor]:
        """Add a batch; see `StageMetrics.update`.

        Args:
            pred_joints: `(B, 24, 3)`, metres, camera frame.
            joints: `(B, 24, 3)`, metres, camera frame, the truth.
            initial_joints: `(B, 24, 3)`, metres, camera frame.
            keypoints: `(B, 24, 2)`, pixels.
            true_keypoints: `(B, 24, 2)`, pixels, the truth.
        """
        return super().update(
            pred_joints=pred_joints,
            joints=joints,
            initial_joints=initial_joints,
            keypoints=keypoints,
            true_keypoints=true_keypoints,
        )
