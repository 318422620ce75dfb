"""The entry point: compose the configuration, run one task, give its metric to a sweeper.

python run.py --help                                       the configuration and its groups
python run.py experiment=detector/proposed                 train, then test the best checkpoint
python run.py task=evaluate ckpt_path=CHECKPOINT           test a checkpoint
python run.py task=predict input=DEPTH.png ...             joints and mesh of a depth image
"""

import logging
import os
import sys

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from ljn.runs.processes import Interruption, end_on_signals, is_first_process
from ljn.tasks.arguments import check_is_read, prepare_arguments
from ljn.tasks.processes import is_job_of_sweep, sweep_name
from ljn.tasks.schema import register

register()


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Run the task that `cfg.task` names; returns the metric that `cfg.optimized_metric` names."""
    end_on_signals()  # also in a process that a launcher has started for a job
    if not is_first_process():
        logging.disable(logging.INFO)  # the first process says it for all
    if cfg.group is None and is_job_of_sweep():
        cfg.group = sweep_name(HydraConfig.get())
    try:
        check_is_read(cfg)
        metrics = hydra.utils.get_method(cfg.task._target_)(cfg)
    except (ValueError, FileNotFoundError, ImportError, FloatingPointError) as error:
        # A user's mistake: the message names the fix. A sweep needs the exception, a developer the traceback.
        if is_job_of_sweep() or os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        sys.exit(f"error: {error}\n(HYDRA_FULL_ERROR=1 shows where it was raised)")
    if is_first_process():
        for name, value in metrics.items():
            print(f"{name:32s}{value:10.3f}")
    return metrics.get(cfg.optimized_metric)


if __name__ == "__main__":
    end_on_signals()
    try:
        sys.argv[1:] = prepare_arguments(sys.argv[1:])
    except (ValueError, ImportError) as error:
        sys.exit(f"error: {error}")
    try:
        main()
    except Interruption as interruption:
        if is_first_process():
            print(
                f"ended by {interruption.name}: a training or a recording is resumed by the same command",
                file=sys.stderr,
            )
        raise
