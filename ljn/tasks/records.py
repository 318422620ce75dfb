"""A run's identity and what it leaves on disk: `config.yaml`, `record.json`, `metrics.json`.

A run's directory is named by the hash of everything that its numbers depend on, so that the same command
finds it again: to resume it, to skip it, or to share it.
"""

import hashlib
import json
import logging
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from omegaconf import DictConfig, OmegaConf, open_dict

from ljn.tasks.processes import is_first_process

RECORD_VERSION = 1
_LOG = logging.getLogger(__name__)

# What may differ between two runs that are the same run; what data files hold is in the data's fingerprint.
_NOT_IDENTITY: dict[str, tuple[str, ...]] = {
    "data": ("source", "cache_dir", "num_workers", "prefetch_batches", "body_path", "detector_ckpt"),
    "module": ("body_path",),
    "callbacks": ("progress", "errors", "pictures"),
    "trainer": (
        "accelerator",
        "devices",
        "strategy",
        "enable_model_summary",
        "log_every_n_steps",
        "profiler",
    ),
}


def identity(cfg: DictConfig, data_fingerprint: str) -> dict[str, Any]:
    """Everything that a run's numbers depend on, as plain values.

    Args:
        cfg: The composed configuration.
        data_fingerprint: See `BodyDataModule.fingerprint`.
    """
    cfg = cfg.copy()
    with open_dict(cfg):
        cfg.paths.run_dir = ""  # named by what comes of this
    plain: dict[str, Any] = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
    kept: dict[str, Any] = {"seed": plain["seed"], "data_fingerprint": data_fingerprint}
    kept |= {"predicted_body": predicted_body(cfg)}
    # Callbacks: what chooses the best epoch, or ends a training.
    for group in ("data", "model", "module", "trainer", "callbacks"):
        dropped = _NOT_IDENTITY.get(group, ())
        content = plain[group] or {}
        kept[group] = {
            key: value for key, value in content.items() if key not in dropped and value is not None
        }
    return kept


def predicted_body(cfg: DictConfig) -> str | None:
    """Hash of the body that a mesh regressor's meshes are of; None for a detector."""
    if "predicted" not in cfg.module:
        return None
    from ljn.body import load_body_models  # and with it PyTorch, which a sweep's report does not need

    [body] = load_body_models(cfg.module.body_path, [cfg.module.predicted])
    return body.hash


def config_hash(plain: Mapping[str, Any]) -> str:
    """First 8 hex digits of the SHA-256 of plain values, whatever the order of their keys; 10 and 10.0 agree."""
    return hashlib.sha256(json.dumps(_canonical(plain), sort_keys=True).encode()).hexdigest()[:8]


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all. NaN and infinity are written as null."""
    draft = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    draft.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")
    draft.replace(path)


def read_json(path: Path) -> dict[str, Any] | None:
    """The content of a JSON file; None where there is none, or a damaged one."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None


def _finite(value: Any) -> Any:
    return _map_floats(value, lambda number: number if math.isfinite(number) else None)


def _canonical(value: Any) -> Any:
    return _map_floats(value, lambda number: int(number) if number.is_integer() else number)


def _map_floats(value: Any, function: Callable[[float], Any]) -> Any:
    if isinstance(value, float):
        return function(value)
    if isinstance(value, Mapping):
        return {key: _map_floats(entry, function) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_map_floats(entry, function) for entry in value]
    return value


class RunRecord:
    """The record of one run, kept on disk from its first moment: a context manager.

    `record.json` says `running` on entry and on exit `complete`, `interrupted` (Ctrl-C, SIGTERM) or `failed`
    with the error; after `kill -9` it still says `running`. A second attempt adds to the wall time. Of a run's
    several processes, the first one alone writes.

    Args:
        directory: The run's directory.
        facts: What else the record holds: name, hashes, seeds, data, device and the like.
    """

    def __init__(self, directory: Path, facts: Mapping[str, Any]) -> None:
        self.directory = directory
        self._writes = is_first_process()
        self._facts = dict(facts)
        before = read_json(directory / "record.json") or {}
        self._wall_time_before = float(before.get("wall_time_s") or 0.0)
        self._attempts = int(before.get("attempts") or 0) + 1

    def __enter__(self) -> Self:
        self.directory.mkdir(parents=True, exist_ok=True)
        self._started = time.monotonic()
        self._facts = {
            "record_version": RECORD_VERSION,
            "status": "running",
            **self._facts,
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "attempts": self._attempts,
            "versions": _versions(),
            "machine": {"platform": platform.platform(), "cpu_count": os.cpu_count()},
            **_commit(),
        }
        self._write()
        return self

    def add(self, **facts: Any) -> None:
        """Add facts, on disk at once."""
        self._facts.update(facts)
        self._write()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.add(status="complete")
        elif isinstance(error, KeyboardInterrupt | SystemExit):
            # The trainer turns Ctrl-C into SystemExit once it has shut down.
            self.add(status="interrupted")
        else:
            self.add(status="failed", error=f"{type(error).__name__}: {error}")

    def _write(self) -> None:
        if not self._writes:
            return
        elapsed = time.monotonic() - self._started
        self._facts["wall_time_s"] = round(self._wall_time_before + elapsed, 1)
        write_json(self.directory / "record.json", self._facts)


@contextmanager
def alone_in(directory: Path) -> Iterator[None]:
    """While it lasts, no other run works in a directory: of two equal runs side by side, the second one waits.

    The lock ends with its process, however that ends. It holds between machines where their shared disk locks files.
    A run's further processes share the lock of the first.
    """
    if not is_first_process():
        yield
        return
    import fcntl

    directory.mkdir(parents=True, exist_ok=True)
    with (directory / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            _LOG.info("%s: another process is at this run; waiting for it", directory)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def is_complete(directory: Path, identity_hash: str) -> bool:
    """Whether a run of that identity has finished in a directory."""
    record = read_json(directory / "record.json") or {}
    return (
        record.get("status") == "complete"
        and record.get("config_hash") == identity_hash
        and read_json(directory / "metrics.json") is not None
    )


def _versions() -> dict[str, str]:
    packages = ("ljn", "torch", "lightning", "numpy", "hydra-core", "numba")
    return {"python": sys.version.split()[0]} | {name: version(name) for name in packages}


def _commit() -> dict[str, Any]:
    """Commit of the code, and whether its files differ from it; None outside a checkout."""

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", *arguments],
                cwd=Path(__file__).parent,
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            )
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip()

    status = git("status", "--porcelain", "--untracked-files=no")
    return {"commit": git("rev-parse", "HEAD"), "is_dirty": None if status is None else bool(status)}
