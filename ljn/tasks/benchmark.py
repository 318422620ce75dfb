"""`task=benchmark`: predictors on fixed samples under many conditions, or on real frames with labels."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ljn.benchmark.outcome import write_outcome
from ljn.benchmark.predictors import Entrant, entrant
from ljn.benchmark.store import Store, short_hash
from ljn.building import build, build_foreign
from ljn.runs.files import path_part
from ljn.runs.packages import DEFAULT, is_package, shipped
from ljn.tasks.overrides import typed_overrides
from ljn.tasks.package import chosen_package
from ljn.tasks.running import use_threads
from ljn.tasks.validation import check_writable

_LOG = logging.getLogger(__name__)
_PIPELINE = "ljn.benchmark.predictors.PipelinePredictor"


def benchmark(cfg: DictConfig) -> dict[str, float]:
    """Measure predictors on `bench`, into `output_dir/benchmarks/NAME-HASH`.

    The same command again takes up what an earlier one has measured, cut off or not: results are kept condition by
    condition, by the hash of the samples, the condition and the predictor's content.

    Args:
        cfg: The composed configuration; of it `bench`, `predictor`, `task`, `ckpt_path`, `weights`, `refine`,
            `body.path`, `paths`, `num_threads`, `rerun` and `trainer.accelerator` count.

    Returns:
        `benchmark/PREDICTOR (CONDITION)`: mean MPJPE, mm.

    Raises:
        FileNotFoundError: A file is missing.
        ValueError: The configuration or a file is wrong; or a predictor failed, after all else is written.
    """
    if cfg.bench is None:
        raise ValueError(
            "bench: expected a benchmark, got null; add bench=ljn_bench, or bench=frames bench.path=FILE"
        )
    directory = Path(cfg.paths.output_dir) / "benchmarks"
    check_writable(directory)
    use_threads(cfg)
    entrants = _entrants(cfg)
    bench = build(cfg.bench)
    store = Store(directory / "conditions", reads=not cfg.rerun)
    with tqdm(unit="condition", disable=None, leave=False) as progress:

        def tick(words: str) -> None:
            progress.update()
            progress.set_description(words)

        outcome = bench.run(entrants, store, tick)
    identity = {"bench": outcome.identity, "predictors": [[each.name, each.fingerprint] for each in entrants]}
    directory /= f"{path_part(outcome.name)}-{short_hash(identity)[:8]}"
    command = " ".join(["python run.py", *typed_overrides()])
    print(write_outcome(directory, outcome, command))
    print(f"in {directory}: index.html, results.csv, samples.csv, table.md")
    if outcome.failures:
        raise ValueError(
            f"{len(outcome.failures)} conditions failed, all others are written; the first: {outcome.failures[0]}"
        )
    return dict(outcome.metrics)


def _entrants(cfg: DictConfig) -> list[Entrant]:
    """The predictors that the call names, each built; of no weights, those that ship."""
    configs: dict[str, Any] = {**_own(cfg)}
    for group in ("predictor", "task.predictors"):
        node = OmegaConf.select(cfg, group)
        typed: Any = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_dict(node) else None
        if node is not None and typed is None:
            raise ValueError(
                f"{group}: expected predictors by name, NAME: {{_target_: MODULE.CLASS}}, got {node!r}"
            )
        configs |= typed or {}
    entrants = []
    for key, config in configs.items():
        if config is None:
            continue
        if not (isinstance(config, Mapping) and "_target_" in config):
            raise ValueError(
                f"task.predictors.{key}: expected a mapping with a _target_, such as {{_target_: my.Predictor}}, got "
                f"{config!r}"
            )
        entrants.append(entrant(build_foreign(config, f"task.predictors.{key}"), str(key), config))
    if not entrants:
        raise ValueError(
            "task.predictors: expected at least one predictor, got none; add weights=small, ckpt_path=DETECTOR.ckpt or "
            "predictor=lifted_keypoints"
        )
    names = [each.name for each in entrants]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"task.predictors: two are called '{twice[0]}'; give one another name=NAME")
    return entrants


def _own(cfg: DictConfig) -> dict[str, Any]:
    """The pipelines that `weights`, `ckpt_path` and `task.checkpoints` name, as configurations of predictors."""
    task = cfg.task
    package = chosen_package(cfg, "ckpt_path", "task.mesh_ckpt_path")
    given: list[dict[str, Any]] = []
    if package is not None:
        given.append({"weights": str(package), "name": None})
    if cfg.ckpt_path is not None:
        given.append({"ckpt_path": cfg.ckpt_path, "mesh_ckpt_path": task.mesh_ckpt_path})
    elif task.mesh_ckpt_path is not None:
        raise ValueError(
            "task.mesh_ckpt_path: expected the joint detector's checkpoint beside it, got none; add ckpt_path=FILE"
        )
    for path in task.checkpoints or ():
        is_weights = is_package(path) or path in shipped()
        given.append({"weights" if is_weights else "ckpt_path": path})
    if not given and not task.predictors and DEFAULT in shipped():
        given.append({"weights": DEFAULT})
    use_gpu = cfg.trainer.accelerator != "cpu" and torch.cuda.is_available()
    shared = {
        "device": "cuda" if use_gpu else "cpu",
        "body_path": cfg.body.path,
        "keypoint_detector": task.keypoint_detector,
    }
    configs = {}
    for number, each in enumerate(given):
        refine = cfg.refine if "mesh_ckpt_path" not in each or each["mesh_ckpt_path"] else None
        configs[f"own_{number}"] = {"_target_": _PIPELINE, **each, "refine": refine, **shared}
    return configs
