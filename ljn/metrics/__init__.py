"""Metrics: functional forms for each sample, and torchmetrics classes that gather them."""

from ljn.metrics.functional import (
    joint_errors_mm,
    keypoint_distances_px,
    mpjpe,
    mpjpe_eq38,
    mpjpe_procrustes,
    mpjpe_root_aligned,
    pckh,
    pckh_threshold_mm,
)
from ljn.metrics.joints import (
    MPJPE,
    JointMetrics,
    MaxKeypointDistance,
    MeanKeypointDistance,
    MPJPEEq38,
    PCKh,
    PCKhThreshold,
    ProcrustesMPJPE,
    RootAlignedMPJPE,
    SampleMax,
    SampleMean,
)

__all__ = [
    "MPJPE",
    "JointMetrics",
    "MPJPEEq38",
    "MaxKeypointDistance",
    "MeanKeypointDistance",
    "PCKh",
    "PCKhThreshold",
    "ProcrustesMPJPE",
    "RootAlignedMPJPE",
    "SampleMax",
    "SampleMean",
    "joint_errors_mm",
    "keypoint_distances_px",
    "mpjpe",
    "mpjpe_eq38",
    "mpjpe_procrustes",
    "mpjpe_root_aligned",
    "pckh",
    "pckh_threshold_mm",
]
