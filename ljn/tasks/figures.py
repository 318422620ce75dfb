"""`task=figures`: Figures 3.12 and 3.13, the same test samples as several checkpoints see them."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig

from ljn.body.skeleton import ROOT
from ljn.building import build
from ljn.data import Batch, DataModule
from ljn.drawing import MeshSample, Sample, draw_meshes, draw_samples
from ljn.metrics import mpjpe
from ljn.modules.joint_detector import JointDetector
from ljn.modules.mesh_regressor import MeshRegressor
from ljn.runs.checkpoints import load_module
from ljn.runs.files import write_json
from ljn.runs.packages import stages_of
from ljn.tasks.overrides import check_bodies, typed_overrides, with_checkpoint_config
from ljn.tasks.package import chosen_package
from ljn.tasks.running import prepare_process
from ljn.tasks.validation import check_writable, validate

_LOG = logging.getLogger(__name__)


class Column(NamedTuple):
    """A checkpoint in a figure."""

    title: str  # what it is and what noise its initial joints have
    module: Any
    batch: Batch  # the test samples with the initial joints that it gets
    facts: dict[str, Any]  # for `figures.json`


def figures(cfg: DictConfig) -> dict[str, float]:
    """Draw the same test samples as several checkpoints see them, a column for each.

    `output_dir/figures/joints.png` (Fig. 3.12) has true (blue) and predicted (red) skeletons, from the front and from
    the side; `meshes.png` (Fig. 3.13) has predicted (red) and true (blue) meshes. The samples are spread evenly over
    the test set, not chosen by hand; `figures.json` names them, with their errors and the checkpoints.

    Args:
        cfg: The composed configuration; of it `task`, `weights`, `paths` and `num_threads` count, and of what was
            typed, what changes the checkpoints' data, as with `task=evaluate`. `task.detectors` and `task.regressors`
            are lists of checkpoints, after which the package comes that `weights` names; `task.keypoint_noise_px`
            gives the noise of each detector's keypoints (null: that of its training); `task.num_samples` says how many
            samples to draw.

    Returns:
        The mean error of the drawn samples in each column, as `figures/joints_0` and so on, mm: MPJPE (root-aligned
        for a detector whose joints are only defined relative to the root) and APVE.

    Raises:
        ValueError: No checkpoint is given, one is of the other stage, or their test sets differ.
        FileNotFoundError: There is no such checkpoint.
    """
    detectors, regressors = list(cfg.task.detectors), list(cfg.task.regressors)
    if (package := chosen_package(cfg)) is not None:
        detectors.append(str(package))
        regressors += [str(package)] * ("mesh" in stages_of(package))
    if not detectors and not regressors:
        raise ValueError(
            "task.detectors, task.regressors: expected checkpoints, got none; python run.py task=figures "
            "'task.detectors=[PROPOSED.ckpt,BASELINE.ckpt]' 'task.regressors=[MESH.ckpt]'"
        )
    noise = cfg.task.keypoint_noise_px
    noise = [None] * len(detectors) if noise is None else list(noise)
    if len(noise) != len(detectors):
        raise ValueError(
            f"task.keypoint_noise_px: expected one value for each of the {len(detectors)} detectors, got {noise}"
        )
    if cfg.task.num_samples < 1:
        raise ValueError(f"task.num_samples: expected at least 1, got {cfg.task.num_samples}")
    directory = Path(cfg.paths.output_dir) / "figures"
    check_writable(directory)

    pages: dict[str, list[Column]] = {"joints": [], "meshes": []}
    for path, noise_px in zip(detectors, noise):
        overrides = [] if noise_px is None else [f"data.synthesis.keypoint_noise_px={noise_px}"]
        pages["joints"].append(_column(cfg, path, JointDetector, "task.detectors", overrides))
    for path in regressors:
        pages["meshes"].append(_column(cfg, path, MeshRegressor, "task.regressors", []))
    _check_same_samples([column for columns in pages.values() for column in columns])

    metrics: dict[str, float] = {}
    drawn: dict[str, Any] = {}
    for page, columns in pages.items():
        if not columns:
            continue
        draw = _draw_joints if page == "joints" else _draw_meshes
        figure, errors = draw(columns)
        figure.savefig(directory / f"{page}.png")
        drawn[page] = [
            column.facts | {"title": column.title, "errors_mm": error.tolist()}
            for column, error in zip(columns, errors)
        ]
        metrics |= {f"figures/{page}_{number}": float(error.mean()) for number, error in enumerate(errors)}
        _LOG.info("%d samples: %s", len(errors[0]), directory / f"{page}.png")
    write_json(directory / "figures.json", drawn)
    return metrics


def _column(cfg: DictConfig, path: str, kind: type, key: str, overrides: Sequence[str]) -> Column:
    """A checkpoint and the test samples as it gets them."""
    module, checkpoint = load_module(path, kind, key)
    number, cfg = (
        cfg.task.num_samples,
        with_checkpoint_config(cfg, checkpoint, [*typed_overrides(), *overrides]),
    )
    validate(cfg)
    prepare_process(cfg)
    datamodule: DataModule = build(cfg.data)
    datamodule.takes = (*module.takes, "points")
    datamodule.prepare_data()
    check_bodies(checkpoint, {body.hash for body in datamodule.bodies} | set(module.body_hashes))
    if number > (num_test := cfg.data.num_test):
        raise ValueError(
            f"task.num_samples: '{path}' has {num_test} test samples, got {number}; ask for fewer"
        )
    # The middles of equal parts of the test set.
    indices = [(2 * index + 1) * num_test // (2 * number) for index in range(number)]
    batch, _ = datamodule.examples("test", indices)
    synthesis = cfg.data.synthesis
    source = "detector" if cfg.data.detector_ckpt else synthesis.initial_joints
    initial = {"lifted": f"{synthesis.keypoint_noise_px:g} px", "noised": f"{synthesis.joint_noise_m:g} m"}
    facts: dict[str, Any] = {"checkpoint": str(checkpoint.path), "hash": checkpoint.file_hash}
    facts |= {"run": checkpoint.run, "samples": batch["sample_id"].tolist()}
    return Column(f"{cfg.name}, {initial.get(source, source)}", module, batch, facts)


def _check_same_samples(columns: Sequence[Column]) -> None:
    first = columns[0]
    for column in columns[1:]:
        pairs = (
            (entry.batch["sample_id"], entry.batch["pose"], entry.batch["joints"])
            for entry in (first, column)
        )
        if not all(map(torch.equal, *pairs)):
            raise ValueError(
                f"task.detectors, task.regressors: the test sets of '{first.facts['checkpoint']}' and "
                f"'{column.facts['checkpoint']}' differ (data.num_test, data.pool_seed, data.eval_seed, camera or "
                "body); a figure compares the same samples"
            )


@torch.no_grad()
def _draw_joints(columns: Sequence[Column]) -> tuple[Any, list[torch.Tensor]]:
    drawn, errors = [], []
    for title, module, batch, _ in columns:
        joints = batch["joints"]
        predicted = module.evaluate(batch, module.test_metrics)["pred_joints"]
        if module.net.is_root_relative:
            predicted = predicted + (joints - predicted)[:, ROOT, None]
            title = f"{title}, root-aligned"
        error = mpjpe(predicted, joints)
        errors.append(error)
        drawn.append(_samples(Sample, title, error, batch, joints, predicted))
    return draw_samples(_by_rows(drawn), len(columns)), errors


@torch.no_grad()
def _draw_meshes(columns: Sequence[Column]) -> tuple[Any, list[torch.Tensor]]:
    drawn, errors = [], []
    for title, module, batch, _ in columns:
        seen = module.evaluate(batch, module.test_metrics)
        errors.append(seen["apve"])
        drawn.append(
            _samples(MeshSample, title, seen["apve"], batch, seen["vertices"], seen["pred_vertices"])
        )
    faces = columns[0].module.body.faces.numpy()
    return draw_meshes(_by_rows(drawn), faces, len(columns)), errors


def _samples(kind: Any, title: str, errors: torch.Tensor, batch: Batch, *values: torch.Tensor) -> list[Any]:
    """What is drawn of each sample, under its error."""
    titles = [f"{title}: {error:.0f} mm" for error in errors]
    arrays = (value.numpy() for value in (batch["points"][..., :3], *values))
    return [kind(*row) for row in zip(*arrays, titles)]


def _by_rows(columns: list[list[Any]]) -> list[Any]:
    """Columns of samples in reading order."""
    return [sample for row in zip(*columns) for sample in row]
