"""`task=show`: look at the data before training on it."""

import logging
from pathlib import Path

from omegaconf import DictConfig

from ljn.building import build
from ljn.data import DataModule
from ljn.drawing import draw_crops, draw_examples
from ljn.tasks.running import prepare_process
from ljn.tasks.validation import validate

_LOG = logging.getLogger(__name__)


def show(cfg: DictConfig) -> dict[str, float]:
    """Draw the first `task.num_samples` training samples of the configured data on `output_dir/show.png`.

    Returns:
        The mean error of their initial joints, mm, as `show/initial_mpjpe`; of colour crops, which have none, nothing.

    Raises:
        ValueError: The configuration or the data it names is wrong.
        FileNotFoundError: A file that it names is missing.
    """
    validate(cfg)
    prepare_process(cfg)
    datamodule: DataModule = build(cfg.data)
    datamodule.prepare_data()
    batch, depth = datamodule.examples("train", range(cfg.task.num_samples))
    path = Path(cfg.paths.output_dir) / "show.png"
    figure = draw_crops(batch) if "rgb" in batch else draw_examples(batch, depth)
    figure.savefig(path)
    _LOG.info("%d samples: %s", len(depth), path)
    if "initial_joints" not in batch:
        return {}
    error = (batch["initial_joints"] - batch["joints"]).norm(dim=-1).mean()
    return {"show/initial_mpjpe": 1000 * float(error)}
