"""Checkpoints: written whole or not at all, with where they came from; read as data, never as code."""

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from ljn.building import build
from ljn.cloud.observation import ObservationRecipe
from ljn.modules.base import StageModule
from ljn.reading import READ_ERRORS
from ljn.runs.keys import CONFIG_GROUPS

CHECKPOINT_VERSION = 3
_PROVENANCE_KEY = "ljn"


class Provenance(Callback):
    """Adds to every checkpoint what is needed to use it alone.

    Args:
        config: The resolved configuration, plain values.
        body_hash: Hashes of the bodies of data and model, joined by "-"; empty without bodies.
        data_licence: What is to be said of the data's licence.
        run: Name of the run's directory.
        recipe: How the observations that it was trained on were made; None where there were none.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        body_hash: str,
        data_licence: str,
        run: str,
        recipe: ObservationRecipe | None,
    ) -> None:
        self.content = {
            "version": CHECKPOINT_VERSION,
            "config": dict(config),
            "body_hash": body_hash,
            "data_licence": data_licence,
            "run": run,
            "observation": None if recipe is None else asdict(recipe),
        }

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the content under its key."""
        checkpoint[_PROVENANCE_KEY] = self.content


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint beside its place, then renames it: a killed run leaves the old one or the new one.

    Lightning's own way passes through the system's temporary folder, and from another file system a move is a
    copy, which can be cut off.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None
    ) -> None:
        """Write `checkpoint` to `path`."""
        draft = f"{path}.{os.getpid()}.tmp"
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.save(checkpoint, draft)
            os.replace(draft, path)
        finally:
            Path(draft).unlink(missing_ok=True)


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint of this library.

    Attributes:
        path: The file.
        config: The resolved configuration that the model was trained with.
        body_hash: Hashes of the bodies that its data showed, joined by "-".
        data_licence: What is said of the data's licence.
        run: Name of the directory of the training run.
        epoch: Epochs completed when it was written.
        recipe: How the observations that it was trained on were made; None where there were none.
        state: The module's state dict.
        file_hash: First 16 hex digits of the file's SHA-256.
    """

    path: Path
    config: dict[str, Any]
    body_hash: str
    data_licence: str
    run: str
    epoch: int
    recipe: ObservationRecipe | None
    state: dict[str, Tensor]
    file_hash: str

    def unknown_bodies(self, hashes: Iterable[str]) -> list[str]:
        """Those of the bodies' hashes that it was not trained with: a model is only meaningful with its bodies."""
        return sorted(set(hashes) - set(self.body_hash.split("-")))


def read_checkpoint(path: str | Path, name: str = "ckpt_path") -> Checkpoint:
    """Read a checkpoint.

    Args:
        path: The file.
        name: The argument to name in errors.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, not a checkpoint of this library, or of a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{name}: no file '{path}'; a run keeps its best checkpoint in RUN_DIRECTORY/checkpoints/best.ckpt"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except READ_ERRORS as error:
        reason = str(error).strip().split("\n")[0]
        raise ValueError(
            f"{name}: '{path}' is damaged, truncated or no checkpoint at all ({reason}); copy it again, or "
            "use another one of the run"
        ) from error
    provenance: Any = content.get(_PROVENANCE_KEY) if isinstance(content, dict) else None
    if not _is_ours(content, provenance):
        raise ValueError(
            f"{name}: '{path}' is a PyTorch file, but no checkpoint that a run of this library wrote: it "
            "carries no whole configuration"
        )
    if provenance["version"] != CHECKPOINT_VERSION:
        newer = provenance["version"] > CHECKPOINT_VERSION
        raise ValueError(
            f"{name}: '{path}' was written by {'a newer' if newer else 'an older'} version of this library "
            f"(checkpoint version {provenance['version']}, this one reads {CHECKPOINT_VERSION}); "
            + (
                "update the library"
                if newer
                else "train it again, or evaluate it with the version it is from"
            )
        )
    return Checkpoint(
        path=path,
        config=provenance["config"],
        body_hash=provenance["body_hash"],
        data_licence=provenance["data_licence"],
        run=provenance["run"],
        epoch=int(content["epoch"]) + 1,
        recipe=_recipe(provenance.get("observation"), path, name),
        state=content["state_dict"],
        file_hash=hashlib.sha256(path.read_bytes()).hexdigest()[:16],
    )


def _recipe(content: Any, path: Path, name: str) -> ObservationRecipe | None:
    if content is None:
        return None
    try:
        return ObservationRecipe(**content)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name}: '{path}' holds no recipe of observations that is known here ({error})"
        ) from error


def _is_ours(content: Any, provenance: Any) -> bool:
    types = {"version": int, "config": dict, "body_hash": str, "data_licence": str, "run": str}
    return (
        isinstance(provenance, dict)
        and all(isinstance(provenance.get(name), kind) for name, kind in types.items())
        and all(group in provenance["config"] for group in CONFIG_GROUPS)
        # A stored configuration is resolved. An interpolation would be resolved here, on this machine's values.
        and not _has_interpolation(provenance["config"])
        and isinstance(content.get("state_dict"), dict)
        and isinstance(content.get("epoch"), int)
    )


def _has_interpolation(value: Any) -> bool:
    if isinstance(value, Mapping):
        return any(_has_interpolation(entry) for entry in value.values())
    if isinstance(value, list | tuple):
        return any(_has_interpolation(entry) for entry in value)
    return isinstance(value, str) and "${" in value


def load_state(module: torch.nn.Module, checkpoint: Checkpoint, argument: str = "ckpt_path") -> None:
    """Load a checkpoint's weights into the module that its configuration describes.

    Args:
        module: The module.
        checkpoint: The checkpoint.
        argument: The argument to name in errors.

    Raises:
        ValueError: The weights belong to another model.
    """
    expected = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    got = {name: tuple(value.shape) for name, value in checkpoint.state.items()}
    if expected != got:
        differing = sorted(
            name for name in expected.keys() | got.keys() if expected.get(name) != got.get(name)
        )
        name = differing[0]
        raise ValueError(
            f"{argument}: '{checkpoint.path}' holds the weights of another model: {len(differing)} tensors differ, "
            f"the first is '{name}', expected {expected.get(name, 'none')}, got {got.get(name, 'none')}"
        )
    module.load_state_dict(checkpoint.state)


def load_module(path: str | Path, kind: type[StageModule], name: str = "ckpt_path") -> tuple[Any, Checkpoint]:
    """The trained module of a checkpoint, in evaluation mode, and the checkpoint.

    Args:
        path: The file.
        kind: What the module must be: `JointDetector` or `MeshRegressor`.
        name: The argument to name in errors.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: See `read_checkpoint` and `load_state`; or the checkpoint is of another kind.
    """
    checkpoint = read_checkpoint(path, name)
    module = build(checkpoint.config["module"])
    if not isinstance(module, kind):
        raise ValueError(
            f"{name}: expected the checkpoint of a {kind.__name__}, but '{path}' is that of a "
            f"{type(module).__name__} ({checkpoint.run}); have two checkpoints changed places?"
        )
    load_state(module, checkpoint, name)
    return module.eval().requires_grad_(False), checkpoint
