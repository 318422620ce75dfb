"""Metrics: functional forms for each sample, and torchmetrics that gather them over a split."""

from ljn.metrics.functional import (
    apve,
    apve_procrustes,
    apve_root_aligned,
    exchanged,
    exchanged_2d,
    harmed,
    joint_errors_mm,
    keypoint_distances_px,
    mpjpe,
    mpjpe_eq38,
    mpjpe_procrustes,
    mpjpe_root_aligned,
    object_keypoint_similarity,
    pckh,
    pckh_2d,
    pckh_root_aligned,
    pckh_threshold_mm,
)
from ljn.metrics.joints import JointMetrics
from ljn.metrics.keypoints import KeypointMetrics
from ljn.metrics.meshes import MeshMetrics, RefinedMeshMetrics
from ljn.metrics.samples import Quantity, SampleAP, SampleMax, SampleMean, SampleMetric, StageMetrics

__all__ = [
    "JointMetrics",
    "KeypointMetrics",
    "MeshMetrics",
    "Quantity",
    "RefinedMeshMetrics",
    "SampleAP",
    "SampleMax",
    "SampleMean",
    "SampleMetric",
    "StageMetrics",
    "apve",
    "apve_procrustes",
    "apve_root_aligned",
    "exchanged",
    "exchanged_2d",
    "harmed",
    "joint_errors_mm",
    "keypoint_distances_px",
    "mpjpe",
    "mpjpe_eq38",
    "mpjpe_procrustes",
    "mpjpe_root_aligned",
    "object_keypoint_similarity",
    "pckh",
    "pckh_2d",
    "pckh_root_aligned",
    "pckh_threshold_mm",
]
