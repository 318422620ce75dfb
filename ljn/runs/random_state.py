"""The state of PyTorch's random numbers, so that a resumed run with dropout equals an uninterrupted one."""

from typing import Any

import torch
from lightning.pytorch import Callback

_KEY = "random_state"


class RandomState(Callback):
    """Keeps the state of PyTorch's global generators in checkpoints, and restores it when a run is resumed."""

    def __init__(self) -> None:
        self._resumed: dict[str, torch.Tensor] = {}

    def on_save_checkpoint(self, trainer: Any, pl_module: Any, checkpoint: dict[str, Any]) -> None:
        """Add the state of the CPU and, where the model is on one, of the GPU."""
        states = {"cpu": torch.get_rng_state()}
        if pl_module.device.type == "cuda":
            states["cuda"] = torch.cuda.get_rng_state(pl_module.device)
        checkpoint[_KEY] = states

    def on_load_checkpoint(self, trainer: Any, pl_module: Any, checkpoint: dict[str, Any]) -> None:
        """Keep the states until the training starts: loaders that are made before that draw numbers, too."""
        self._resumed = checkpoint.get(_KEY, {})

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        """Set the states."""
        if "cpu" in self._resumed:
            torch.set_rng_state(self._resumed["cpu"].cpu())
        if "cuda" in self._resumed and pl_module.device.type == "cuda":
            torch.cuda.set_rng_state(self._resumed["cuda"].cpu(), pl_module.device)
