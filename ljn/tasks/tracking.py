"""Trackers: what is logged once of a run, the run's end, and a sweep's table."""

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning.pytorch as lightning
from hydra.utils import get_class
from lightning.pytorch.loggers import WandbLogger

from ljn.runs.identity import config_hash

_LOG = logging.getLogger(__name__)
_PATIENCE_S = 20.0
"""How long W&B's server is waited for."""


@contextmanager
def tracking(
    trainer: lightning.Trainer, run_id: str, config: Mapping[str, Any], trained_by: str | None = None
) -> Iterator[None]:
    """A context in which the trainer's loggers follow one run; at its end W&B's run ends, as failed after an error.

    Without that end, jobs of one process would share a run. W&B's job type is `train` or `evaluate`; of a
    validation metric its summary keeps the best value. An evaluation has the directory and W&B's id of its
    training run in its config, as `trained_by` and `trained_by_id`, and in its notes. `run_id` is the hash that names
    the run, and W&B's id of it, with which a resumed run goes on; `config` is resolved, plain values.
    """
    _quieten_wandb()
    hyperparameters = dict(config)
    about: dict[str, Any] = {"id": run_id, "resume": "allow", "job_type": "train"}
    if trained_by:
        # A run's directory ends with the hash that is its id.
        hyperparameters |= {"trained_by": trained_by, "trained_by_id": trained_by.rpartition("-")[2]}
        about |= {"job_type": "evaluate", "notes": f"Evaluation of {trained_by}"}
    loggers = [logger for logger in trainer.loggers if isinstance(logger, WandbLogger)]
    exit_code = 1
    try:
        for logger in loggers:
            logger._wandb_init.update(about)
            logger._wandb_init.pop("anonymous", None)  # of no effect, and W&B warns of it
            _start(logger)
            for metric, summary in summaries(config).items():
                logger.experiment.define_metric(metric, step_metric="trainer/global_step", summary=summary)
        for each in trainer.loggers:
            each.log_hyperparams(hyperparameters)
        yield
        exit_code = 0
    finally:
        if loggers:
            import wandb

            wandb.finish(exit_code=exit_code)


def _start(logger: WandbLogger) -> None:
    """Begin W&B's run; offline where its server cannot be reached, so that nothing waits for a network."""
    import wandb

    if logger._offline:
        return
    settings = wandb.Settings(init_timeout=_PATIENCE_S)
    logger._wandb_init["settings"] = settings
    try:
        _ = logger.experiment
    except (wandb.errors.CommError, wandb.errors.UsageError) as error:
        _LOG.warning(
            "W&B cannot be reached (%s): the run is kept offline; `wandb sync` uploads what is in %s later",
            str(error).partition("\n")[0],
            logger.save_dir,
        )
        wandb.teardown()  # W&B's own process still holds the run
        logger._offline = True
        logger._wandb_init |= {"mode": "offline", "settings": wandb.Settings()}


def summaries(config: Mapping[str, Any]) -> dict[str, str]:
    """Which of a validation metric's values a run's summary keeps: `min`, `max` or `last`."""
    module: Any = get_class(config["module"]["_target_"])
    best = {None: "last", False: "min", True: "max"}
    metrics = module.metrics(prefix="val/").items()
    return {"train/loss": "min"} | {name: best[metric.higher_is_better] for name, metric in metrics}


def log_table(
    name: str, rows: Sequence[Mapping[str, Any]], logger: Mapping[str, Any] | None, directory: str | Path
) -> None:
    """Log a sweep's table to W&B, as a separate run in the sweep's group, of the job type `report`.

    The table of the same name, group and project is the same run and is replaced. Nothing happens where W&B is not
    among the loggers of the sweep's jobs. A table has a column for each key that any of its rows has; what is no
    number or text becomes text.
    """
    node = (logger or {}).get("wandb")
    if node is None or not rows:
        return
    _quieten_wandb()
    import wandb

    columns = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[_as_cell(row.get(column)) for column in columns] for row in rows]
    project, group = node.get("project"), node.get("group")
    Path(directory).mkdir(parents=True, exist_ok=True)
    with wandb.init(
        project=project,
        entity=node.get("entity"),
        group=group,
        job_type="report",
        name=name,
        id=config_hash({"project": project, "group": group, "table": name}),
        resume="allow",
        dir=str(directory),
        mode="offline" if node.get("offline") else None,
        reinit="create_new",
    ) as run:
        run.log({name: wandb.Table(columns=[*columns], data=cells, allow_mixed_types=True)})


def _as_cell(value: Any) -> Any:
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _quieten_wandb() -> None:
    # Its closing banner would bury a sweep's lines; WANDB_SILENT=false brings it back.
    os.environ.setdefault("WANDB_SILENT", "true")
