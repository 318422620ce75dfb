"""`task=export`: samples of the configured data as files that a user could have made, with their truth."""

import logging
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ljn.body import GENDERS
from ljn.building import build
from ljn.data import SPLITS, DataModule
from ljn.geometry.camera import Camera
from ljn.pipeline.samples import DEPTH, Truth, write_camera, write_sample
from ljn.runs.files import path_part
from ljn.tasks.running import prepare_process
from ljn.tasks.validation import check_writable, validate

_LOG = logging.getLogger(__name__)
_GENDERS = {code: gender for gender, code in GENDERS.items()}
_FARTHEST_M = 65.0  # of 16 bits in millimetres


def export(cfg: DictConfig) -> dict[str, float]:
    """Write the samples `task.indices` of `task.split` into `task.directory`; see `ljn.pipeline.samples`.

    Depth images have the data's noise, and keypoints theirs; `task=predict` reads both, and `task=demo` the whole
    folder.

    Args:
        cfg: The composed configuration, whose `data` the samples are of.

    Returns:
        `export/samples`, how many were written.

    Raises:
        ValueError: The configuration is wrong, the samples have several cameras, or the folder holds other samples.
        FileNotFoundError: A file that the data names is missing.
    """
    validate(cfg)
    names = _names(cfg.task)
    directory = Path(cfg.task.directory or Path(cfg.paths.output_dir) / "export")
    check_writable(directory, "task.directory")
    if others := sorted({path.stem for path in (directory / DEPTH).glob("*")} - set(names)):
        raise ValueError(
            f"task.directory: '{directory}' holds other samples, such as '{others[0]}', perhaps of another camera; "
            "choose an empty folder with task.directory=FOLDER"
        )
    prepare_process(cfg)
    datamodule: DataModule = build(cfg.data)
    datamodule.takes = ("confidences",)
    datamodule.prepare_data()
    batch, depth = datamodule.examples(cfg.task.split, list(cfg.task.indices))
    if "keypoints" not in batch:
        raise ValueError(
            "data: task=export writes depth images and keypoints, got colour crops; use data=synthetic"
        )
    if len(cameras := batch["camera"].unique(dim=0)) > 1:
        raise ValueError(
            "data.synthesis: expected one camera for all samples of a folder, got several; add "
            "'data.synthesis.focal_factors=[1,1]' 'data.synthesis.pixel_factors=[1,1]'"
        )
    # The shortest decimal numbers that are these in float32: those of the configuration.
    height, width = depth.shape[1:]
    fx, fy, cx, cy = (float(str(value)) for value in cameras[0].numpy())
    write_camera(directory, Camera(fx, fy, cx, cy, width, height))
    is_missing = batch["confidences"] == 0
    hashes = {body.gender: body.hash for body in datamodule.bodies}
    for number, name in enumerate(names):
        keypoints = batch["keypoints"][number].tolist()
        if is_missing.any():
            keypoints = [
                [*row, 1.0 - missing] for row, missing in zip(keypoints, is_missing[number].tolist())
            ]
        gender = _GENDERS[int(batch["gender"][number])]
        truth = Truth(
            batch["joints"][number].numpy(),
            batch["pose"][number].numpy(),
            batch["betas"][number].numpy(),
            gender,
            hashes[gender],
        )
        image = depth[number].numpy()
        if image.max() > _FARTHEST_M:
            raise ValueError(f"data: {name} is {image.max():.1f} m away, too far for millimetres in 16 bits")
        write_sample(directory, name, image, keypoints, truth)
    _LOG.info("%d samples of the %s set: %s", len(names), cfg.task.split, directory)
    return {"export/samples": float(len(names))}


def _names(task: Any) -> list[str]:
    """The samples' names; raises a `ValueError` where what is asked for makes no sense."""
    if task.split not in SPLITS:
        raise ValueError(f"task.split: expected one of {', '.join(SPLITS)}, got '{task.split}'")
    plain = OmegaConf.to_container(task)
    assert isinstance(plain, dict)
    indices, names = plain["indices"], plain["names"]
    if not isinstance(indices, list) or not indices or not all(type(index) is int for index in indices):
        raise ValueError(f"task.indices: expected numbers of samples, as in [0,1,2], got {indices!r}")
    if names is None:
        names = [f"{task.split}_{index}" for index in indices]
    if not isinstance(names, list) or len(set(map(str, names))) != len(indices):
        raise ValueError(
            f"task.names: expected {len(indices)} different names, got {names!r}; or leave them out"
        )
    return [path_part(str(name)) for name in names]
