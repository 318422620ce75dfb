"""Metrics: functional forms for each sample, and torchmetrics that gather them over a split."""

from ljn.metrics.functional import (
    apve,
    apve_procrustes,
    apve_root_aligned,
    exchanged,
    harmed,
    joint_errors_mm,
    keypoint_distances_px,
    mpjpe,
    mpjpe_eq38,
    mpjpe_procrustes,
    mpjpe_root_aligned,
    pckh,
    pckh_root_aligned,
    pckh_threshold_mm,
)
from ljn.metrics.joints import JointMetrics
from ljn.metrics.meshes import MeshMetrics, RefinedMeshMetrics
from ljn.metrics.samples import Quantity, SampleMax, SampleMean, SampleMetric, StageMetrics

__all__ = [
    "JointMetrics",
    "MeshMetrics",
    "Quantity",
    "RefinedMeshMetrics",
    "SampleMax",
    "SampleMean",
    "SampleMetric",
    "StageMetrics",
    "apve",
    "apve_procrustes",
    "apve_root_aligned",
    "exchanged",
    "harmed",
    "joint_errors_mm",
    "keypoint_distances_px",
    "mpjpe",
    "mpjpe_eq38",
    "mpjpe_procrustes",
    "mpjpe_root_aligned",
    "pckh",
    "pckh_root_aligned",
    "pckh_threshold_mm",
]
