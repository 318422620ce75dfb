"""`task=cross`: a trained model on data that it was not trained for; rows of the thesis's tables."""

from typing import Any

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from ljn.building import build
from ljn.runs.keys import key_of
from ljn.tasks.arguments import quoted
from ljn.tasks.evaluate import evaluate_checkpoint
from ljn.tasks.overrides import apply_overrides, typed_overrides
from ljn.tasks.train import composed, trained
from ljn.tasks.validation import validate


def cross(cfg: DictConfig) -> dict[str, float]:
    """Train a configuration, or find it trained, then test its best checkpoint on changed data.

    Args:
        cfg: The composed configuration. `task.trains` names the experiment whose run is meant, so that rows share
            it; `task.overrides` change single values of the data, as with `task=evaluate`; `task.detector` is the
            experiment of a joint detector, trained or found in the same way, that gives the initial joints.

    Returns:
        The test metrics, also in `metrics.json` of the evaluation's directory, which is left in `paths.run_dir`.

    Raises:
        ValueError: See `train` and `evaluate`; or `task.trains` is not set.
    """
    task = cfg.task
    if task.trains is None:
        raise ValueError(
            "task.trains: expected the experiment whose run is tested, got null; choose a row, as in "
            "experiment=mesh/chain"
        )
    _check_trains(cfg)
    overrides = list(task.overrides)
    # Before the training, which knows nothing of them.
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    changed = OmegaConf.create(plain)
    apply_overrides(changed, overrides)
    validate(changed)
    build(changed.data)
    if task.detector is not None:
        detector = trained(composed(task.detector), task.detector)
        overrides.append(f"data.detector_ckpt={quoted(detector)}")
    alone = cfg.copy()
    alone.task.detector = alone.refine = None  # they are for the test
    return evaluate_checkpoint(cfg, trained(alone, task.trains), overrides, cfg.name, reuses=True)


def _check_trains(cfg: DictConfig) -> None:
    """Raise a `ValueError` unless the experiment that `task.trains` names is configured as this row is.

    Without Hydra's own start there is no other experiment to compose: the caller has composed this one.
    """
    typed = typed_overrides()
    if not typed:
        return
    typed = [line for line in typed if key_of(line).split(".")[0] not in ("experiment", "name", "task")]
    row = compose("config", [f"experiment={cfg.task.trains}", *typed])
    for group in ("model", "module", "data", "trainer"):
        if row[group] != cfg[group]:
            raise ValueError(
                f"task.trains: '{cfg.task.trains}' has another {group} than this row; choose the row of that "
                f"experiment, or write one whose defaults begin with it"
            )
