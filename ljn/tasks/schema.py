"""Types of the configuration's root; imported before anything heavy, so `--help` is quick."""

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore


@dataclass
class Config:
    """The root of the configuration; groups are typed by what their `_target_` accepts."""

    name: str = "run"
    tags: list[str] = field(default_factory=list)
    group: str | None = None
    seed: int = 0
    num_threads: int | None = None
    ckpt_path: str | None = None
    weights: str | None = None
    refine: Any = None
    rerun: bool = False
    tables: list[str] = field(default_factory=list)
    optimized_metric: str = "val/mpjpe"
    task: Any = None
    bench: Any = None
    predictor: Any = None
    recording: Any = None
    segmentation: Any = None
    preset: Any = None
    data: Any = None
    body: Any = None
    model: Any = None
    module: Any = None
    trainer: Any = None
    callbacks: Any = None
    logger: Any = None
    paths: Any = None


def register() -> None:
    """Make the schema known to Hydra as the config `schema`."""
    ConfigStore.instance().store(name="schema", node=Config)
