"""A trained stage: its module, how its observations are made, where it comes from."""

from pathlib import Path
from typing import Any, NamedTuple

import torch

from ljn.cloud.observation import ObservationRecipe
from ljn.cloud.rgb import RgbRecipe
from ljn.modules.base import StageModule
from ljn.runs.checkpoints import Checkpoint, load_module


class Stage(NamedTuple):
    """A trained module, how its observations are made, and where it comes from.

    Attributes:
        module: A `JointDetector`, a `MeshRegressor` or a `KeypointDetector`.
        recipe: How the observations of its training were made: an `ObservationRecipe`, of colour images a `RgbRecipe`.
        origin: Path, hash, run and epoch of its checkpoint: for records.
    """

    module: Any
    recipe: Any
    origin: dict[str, Any]


def load_stage(
    path: str | Path,
    kind: type[StageModule],
    name: str,
    device: str | torch.device = "cpu",
    body_path: str | Path | None = None,
    of_colour: bool = False,
) -> tuple[Stage, Checkpoint]:
    """The stage of a checkpoint or a package, and the checkpoint.

    Args:
        path: See `load_module`.
        kind: See `load_module`.
        name: See `load_module`.
        device: Where the network runs.
        body_path: See `load_module`.
        of_colour: Whether it may have been trained on colour images.

    Raises:
        FileNotFoundError: See `load_module`.
        ValueError: See `load_module`; or no observations can be made for it.
    """
    module, checkpoint = load_module(path, kind, name, body_path)
    kinds = (ObservationRecipe, RgbRecipe) if of_colour else (ObservationRecipe,)
    if not isinstance(checkpoint.recipe, kinds):
        raise ValueError(
            f"{name}: '{path}' was not trained on observations of depth images, so none can be made for it"
        )
    origin = {
        "path": str(checkpoint.path),
        "hash": checkpoint.file_hash,
        "run": checkpoint.run,
        "epoch": checkpoint.epoch,
        "body_hash": checkpoint.body_hash,
    }
    return Stage(module.to(device), checkpoint.recipe, origin), checkpoint
