"""The record of a run, `record.json`, and the lock on its directory."""

import logging
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ljn.runs import layout
from ljn.runs.files import read_json, read_metrics, write_json
from ljn.runs.processes import Interruption, is_first_process

RECORD_VERSION = 1
_LOG = logging.getLogger(__name__)


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
        before = read_json(directory / layout.RECORD) or {}
        seconds, attempts = before.get("wall_time_s"), before.get("attempts")
        self._wall_time_before = seconds if isinstance(seconds, float) else 0.0
        self._attempts = (attempts if isinstance(attempts, int) else 0) + 1

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
            return
        # What ends a process, such as `Interruption`, is no error of the run; nor is what it leads to: a signal to a
        # group of processes ends data workers, too, and the loader makes an error of that.
        interruption = _interruption_behind(error)
        is_failure = isinstance(error, Exception) and interruption is None
        ending = {"status": "failed", "error": f"{type(error).__name__}: {error}"}
        try:
            self.add(**ending if is_failure else {"status": "interrupted"})
        except OSError as unwritten:  # the error that ended the run is the one to see
            _LOG.warning("%s: the record's last state cannot be written: %s", self.directory, unwritten)
        if interruption is not None and interruption is not error:
            raise interruption from None

    def _write(self) -> None:
        if not self._writes:
            return
        elapsed = time.monotonic() - self._started
        self._facts["wall_time_s"] = round(self._wall_time_before + elapsed, 1)
        write_json(self.directory / layout.RECORD, self._facts)


def _interruption_behind(error: BaseException | None) -> Interruption | None:
    while error is not None and not isinstance(error, Interruption):
        error = error.__context__
    return error


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
    record = read_json(directory / layout.RECORD) or {}
    return (
        record.get("status") == "complete"
        and record.get("config_hash") == identity_hash
        and read_metrics(directory) is not None
    )


def _versions() -> dict[str, str]:
    packages = ("ljn", "torch", "lightning", "numpy", "hydra-core", "numba")
    return {"python": sys.version.split()[0]} | {name: version(name) for name in packages}


def _commit() -> dict[str, Any]:
    """Commit of the code, and whether its files differ from it; None outside a checkout."""

    def git(*arguments: str) -> str | None:
        try:
            options: dict[str, Any] = {"stderr": subprocess.DEVNULL, "text": True, "timeout": 10}
            return subprocess.check_output(["git", *arguments], cwd=Path(__file__).parent, **options).strip()
        except (OSError, subprocess.SubprocessError):
            return None

    status = git("status", "--porcelain", "--untracked-files=no")
    return {"commit": git("rev-parse", "HEAD"), "is_dirty": None if status is None else bool(status)}
