"""Reading checkpoints: data, never code, with a clear error for what is not one of ours."""

import hashlib
import pickle
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

CHECKPOINT_VERSION = 1
PROVENANCE_KEY = "ljn"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint of this library.

    Attributes:
        path: The file.
        config: The resolved configuration that the model was trained with.
        body_hash: Hash of the body that its data showed.
        data_licence: What is said of the data's licence.
        run: Name of the directory of the training run.
        epoch: Epochs completed when it was written.
        state: The module's state dict.
        file_hash: First 16 hex digits of the file's SHA-256.
    """

    path: Path
    config: dict[str, Any]
    body_hash: str
    data_licence: str
    run: str
    epoch: int
    state: dict[str, Tensor]
    file_hash: str


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Read a checkpoint.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, not a checkpoint of this library, or of a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"ckpt_path: no file '{path}'; a run keeps its best checkpoint in RUN_DIRECTORY/checkpoints/best.ckpt"
        )
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, pickle.UnpicklingError, zipfile.BadZipFile, ValueError) as error:
        reason = str(error).strip().split("\n")[0]
        raise ValueError(
            f"ckpt_path: '{path}' is damaged, truncated or no checkpoint at all ({reason}); copy it again, or "
            "use another one of the run"
        ) from error
    provenance = content.get(PROVENANCE_KEY) if isinstance(content, dict) else None
    if not isinstance(provenance, dict) or "state_dict" not in content:
        raise ValueError(
            f"ckpt_path: '{path}' is a PyTorch file, but no checkpoint that a run of this library wrote: it "
            "carries no configuration"
        )
    if provenance["version"] > CHECKPOINT_VERSION:
        raise ValueError(
            f"ckpt_path: '{path}' was written by a newer version of this library (checkpoint version "
            f"{provenance['version']}, known up to {CHECKPOINT_VERSION}); update the library"
        )
    return Checkpoint(
        path=path,
        config=provenance["config"],
        body_hash=provenance["body_hash"],
        data_licence=provenance["data_licence"],
        run=provenance["run"],
        epoch=int(content["epoch"]) + 1,
        state=content["state_dict"],
        file_hash=hashlib.sha256(path.read_bytes()).hexdigest()[:16],
    )


def load_state(module: torch.nn.Module, checkpoint: Checkpoint) -> None:
    """Load a checkpoint's weights into the module that its configuration describes.

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
            f"ckpt_path: '{checkpoint.path}' holds the weights of another model: {len(differing)} tensors differ, "
            f"the first is '{name}', expected {expected.get(name, 'none')}, got {got.get(name, 'none')}"
        )
    module.load_state_dict(checkpoint.state)
