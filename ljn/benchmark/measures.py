"""Errors of each sample, and what a report says of many."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from ljn.benchmark.frames import BenchTruth
from ljn.benchmark.predictors import Found
from ljn.body.skeleton import ROOT
from ljn.metrics import (
    apve,
    apve_root_aligned,
    exchanged,
    joint_errors_mm,
    mpjpe_procrustes,
    mpjpe_root_aligned,
)

Errors = Mapping[str, np.ndarray]
"""Of S samples, by name: `joints_mm` `(S, 24)`, and `(S,)` each `mpjpe`, `root_aligned`, `procrustes` (mm), `under_50`,
`under_100` (% of the joints), `exchanged` (100 or 0) and, of meshes, `pve` and `pve_root_aligned` (mm); float32."""


class Column(NamedTuple):
    """A number that a report gives of many samples.

    Attributes:
        key: For files.
        label: For tables.
        error: A key of `Errors`.
        statistic: `mean`, `median` or `p90`, the 90th percentile.
    """

    key: str
    label: str
    error: str
    statistic: str = "mean"


_STATISTICS = {"mean": "mean", "median": "median", "p90": "90 %"}
COLUMNS: tuple[Column, ...] = (
    *(
        Column(f"{error}_{statistic}", f"{label}{words}", error, statistic)
        for error, label in (("mpjpe", "MPJPE"), ("root_aligned", "root-aligned"), ("procrustes", "Procrustes"))
        for statistic, words in zip(_STATISTICS, ("", ", median", ", 90 %"))
    ),
    Column("under_5cm", "joints < 5 cm, %", "under_50"),
    Column("under_10cm", "joints < 10 cm, %", "under_100"),
    Column("exchanged", "sides exchanged, %", "exchanged"),
    Column("pve_mean", "PVE", "pve"),
    Column("pve_median", "PVE, median", "pve", "median"),
    Column("pve_root_aligned_mean", "PVE, root-aligned", "pve_root_aligned"),
    Column("pve_root_aligned_median", "PVE, root-aligned, median", "pve_root_aligned", "median"),
)  # fmt: skip
"""Errors in millimetres, of samples' means over their joints or vertices."""


def measure(found: Found, truth: BenchTruth) -> dict[str, np.ndarray]:
    """The errors of a batch; see `Errors`.

    Raises:
        ValueError: The vertices are of another topology than the truth's.
    """
    joints, true_joints = torch.from_numpy(found.joints), torch.from_numpy(truth.joints)
    distances = joint_errors_mm(joints, true_joints)
    errors = {
        "joints_mm": distances,
        "mpjpe": distances.mean(-1),
        "root_aligned": mpjpe_root_aligned(joints, true_joints),
        "procrustes": mpjpe_procrustes(joints, true_joints),
        "under_50": 100.0 * (distances < 50).double().mean(-1),
        "under_100": 100.0 * (distances < 100).double().mean(-1),
        "exchanged": exchanged(joints, true_joints),
    }
    if found.vertices is not None:
        if found.vertices.shape != truth.vertices.shape:
            raise ValueError(
                f"vertices: expected those of the truth's topology, {truth.vertices.shape}, got "
                f"{found.vertices.shape}; a predictor of other meshes gives None for its vertices"
            )
        vertices, true_vertices = torch.from_numpy(found.vertices), torch.from_numpy(truth.vertices)
        roots = (joints[:, ROOT].double(), true_joints[:, ROOT].double())
        errors["pve"] = apve(vertices, true_vertices)
        errors["pve_root_aligned"] = apve_root_aligned(vertices, true_vertices, *roots)
    return {name: value.numpy().astype(np.float32) for name, value in errors.items()}


def summary(errors: Errors) -> dict[str, float]:
    """The numbers of `COLUMNS` that these errors have; of no samples none."""
    if not len(errors["mpjpe"]):
        return {}
    return {
        column.key: statistic(errors[column.error], column.statistic)
        for column in COLUMNS
        if column.error in errors
    }


def statistic(values: np.ndarray, name: str) -> float:
    """A statistic of `Column`, in float64."""
    values = np.asarray(values, np.float64)
    if name == "mean":
        return float(values.mean())
    return float(np.percentile(values, 50 if name == "median" else 90))


def chosen(errors: Errors, rows: np.ndarray | slice) -> dict[str, np.ndarray]:
    """The errors of some samples."""
    return {name: values[rows] for name, values in errors.items()}
