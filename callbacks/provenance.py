"""Where a checkpoint came from, inside the checkpoint."""

from collections.abc import Mapping
from typing import Any

from lightning.pytorch import Callback, LightningModule, Trainer

from ljn.tasks.checkpoints import CHECKPOINT_VERSION, PROVENANCE_KEY


class Provenance(Callback):
    """Adds to every checkpoint what is needed to use it alone.

    Args:
        config: The resolved configuration, plain values.
        body_hash: The body's hash.
        data_licence: What is to be said of the data's licence.
        run: Name of the run's directory.
    """

    def __init__(self, config: Mapping[str, Any], body_hash: str, data_licence: str, run: str) -> None:
        self.content = {
            "version": CHECKPOINT_VERSION,
            "config": dict(config),
            "body_hash": body_hash,
            "data_licence": data_licence,
            "run": run,
        }

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the content under its key."""
        checkpoint[PROVENANCE_KEY] = self.content
