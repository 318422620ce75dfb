"""The keypoint detector's metrics: 2D joints in the image."""

from typing import ClassVar

from torch import Tensor

from ljn.metrics import functional
from ljn.metrics.samples import Quantity, SampleAP, StageMetrics

_PREDICTED = ("pred_keypoints", "keypoints")


class KeypointMetrics(StageMetrics):
    """Every metric of the keypoint detector under its key, for one split; see `StageMetrics`.

    `keypoint_error_px` is in pixels of the whole image, `crop_error_px` in those of the crop that the network sees. The
    score of `oks_ap` is the mean confidence. `exchanged` is the share of left-right flips.
    """

    table: ClassVar = {
        "keypoint_error_px": Quantity(functional.keypoint_distances_px, _PREDICTED, "px"),
        "crop_error_px": Quantity(functional.keypoint_distances_px, ("pred_in_crop", "in_crop"), "px"),
        "pckh": Quantity(functional.pckh_2d, (*_PREDICTED, "joints", "focal_px"), "%", "max"),
        "oks_ap": Quantity(functional.scored_similarity, (*_PREDICTED, "confidences"), "%", "max", SampleAP),
        "exchanged": Quantity(functional.exchanged_2d, _PREDICTED, "%"),
    }
    headline = ("keypoint_error_px", "pckh", "oks_ap", "exchanged")

    def update(  # type: ignore[override]
        self,
        pred_keypoints: Tensor,
        keypoints: Tensor,
        pred_in_crop: Tensor,
        in_crop: Tensor,
        confidences: Tensor,
        joints: Tensor,
        focal_px: Tensor,
    ) -> dict[str, Tensor]:
        """Add a batch; see `StageMetrics.update`.

        Args:
            pred_keypoints: `(B, 24, 2)`, pixels of the image.
            keypoints: `(B, 24, 2)`, the truth.
            pred_in_crop: `(B, 24, 2)`, pixels of the crop.
            in_crop: `(B, 24, 2)`, the truth.
            confidences: `(B, 24)`.
            joints: `(B, 24, 3)`, metres, camera frame, the truth.
            focal_px: `(B,)`, of the image.
        """
        return super().update(
            pred_keypoints=pred_keypoints,
            keypoints=keypoints,
            pred_in_crop=pred_in_crop,
            in_crop=in_crop,
            confidences=confidences,
            joints=joints,
            focal_px=focal_px,
        )
