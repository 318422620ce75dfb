"""Trackers: what they are told once, and their end."""

import os
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as lightning
from lightning.pytorch.loggers import WandbLogger


def link_run(
    trainer: lightning.Trainer, run_id: str, config: Mapping[str, Any], trained_by: str | None = None
) -> None:
    """Give the trackers the configuration, and W&B the run's own id, with which a resumed run goes on.

    Args:
        trainer: The trainer whose loggers are meant.
        run_id: Hash that names the run.
        config: Resolved configuration, plain values.
        trained_by: For an evaluation: the training run that the checkpoint came from.
    """
    # Its closing banner would bury a sweep's lines; WANDB_SILENT=false brings it back.
    os.environ.setdefault("WANDB_SILENT", "true")
    for logger in trainer.loggers:
        if isinstance(logger, WandbLogger):
            logger._wandb_init.update(id=run_id, resume="allow")
        logger.log_hyperparams({**config, "trained_by": trained_by} if trained_by else dict(config))


def finish_tracking(trainer: lightning.Trainer) -> None:
    """End the W&B run: without it, jobs of one process would share a run."""
    if any(isinstance(logger, WandbLogger) for logger in trainer.loggers):
        import wandb

        wandb.finish()
