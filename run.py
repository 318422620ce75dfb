"""The entry point: compose the configuration, run one task, give its metric to a sweeper.

python run.py --help                                       the configuration and its groups
python run.py experiment=detector/proposed                 train, then test the best checkpoint
python run.py task=evaluate ckpt_path=CHECKPOINT           test a checkpoint
"""

import hydra
from omegaconf import DictConfig

from ljn.tasks.schema import register

register()


@hydra.main(version_base="1.3", config_path="conf", config_name="config")
def main(cfg: DictConfig) -> float | None:
    """Run the task that `cfg.task` names; returns the metric that `cfg.optimized_metric` names."""
    metrics = hydra.utils.get_method(cfg.task._target_)(cfg)
    for name, value in metrics.items():
        print(f"{name:32s}{value:10.3f}")
    return metrics.get(cfg.optimized_metric)


if __name__ == "__main__":
    main()
