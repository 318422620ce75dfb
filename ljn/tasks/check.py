"""`task=check`: hold the data's files against themselves, before a training or an evaluation."""

from omegaconf import DictConfig

from ljn.building import build
from ljn.data import DataModule, Finding
from ljn.tasks.running import prepare_process
from ljn.tasks.validation import validate


def check(cfg: DictConfig) -> dict[str, float]:
    """Read the files of the configured data, print what is found in `task.num_clips` clips, a line each.

    Returns:
        The largest of each number, as `check/NAME`.

    Raises:
        ValueError: The configuration is wrong, or the data cannot be used as they are.
        FileNotFoundError: A file that it names is missing.
    """
    if cfg.task.num_clips is not None and cfg.task.num_clips < 1:
        raise ValueError(f"task.num_clips: expected 1 or more, or null for all, got {cfg.task.num_clips}")
    validate(cfg)
    prepare_process(cfg)
    datamodule: DataModule = build(cfg.data)
    datamodule.prepare_data()
    largest: dict[str, float] = {}
    wrong: list[Finding] = []
    for finding in datamodule.examine(cfg.task.num_clips):
        print(finding.text, flush=True)
        wrong += [finding] if finding.is_wrong else []
        for name, value in finding.values.items():
            largest[f"check/{name}"] = max(value, largest.get(f"check/{name}", value))
    if wrong:
        raise ValueError(f"data: {wrong[-1].text}")
    if not largest:
        print("What is not named above is whole; there is nothing that it could be held against.")
    return largest
