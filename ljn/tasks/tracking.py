"""Trackers: what they are told once, and their end."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import lightning.pytorch as lightning
from lightning.pytorch.loggers import WandbLogger


@contextmanager
def tracking(
    trainer: lightning.Trainer, run_id: str, config: Mapping[str, Any], trained_by: str | None = None
) -> Iterator[None]:
    """While it lasts, the trainer's loggers follow one run; then W&B's run is ended, as failed after an error.

    Without that end, jobs of one process would share a run.

    Args:
        trainer: The trainer whose loggers are meant.
        run_id: Hash that names the run: W&B's own id, with which a resumed run goes on.
        config: Resolved configuration, plain values.
        trained_by: For an evaluation: the training run that the checkpoint came from.
    """
    has_wandb = any(isinstance(logger, WandbLogger) for logger in trainer.loggers)
    # Its closing banner would bury a sweep's lines; WANDB_SILENT=false brings it back.
    os.environ.setdefault("WANDB_SILENT", "true")
    exit_code = 1
    try:
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                logger._wandb_init.update(id=run_id, resume="allow")
                logger._wandb_init.pop("anonymous", None)  # of no effect, and W&B warns of it
            logger.log_hyperparams({**config, "trained_by": trained_by} if trained_by else dict(config))
        yield
        exit_code = 0
    finally:
        if has_wandb:
            import wandb

            wandb.finish(exit_code=exit_code)
