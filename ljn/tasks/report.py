"""`task=report`: the tables and the page of a sweep, written again from its runs."""

import logging
from pathlib import Path

from omegaconf import DictConfig

from ljn.report import write_report
from ljn.runs import layout

_LOG = logging.getLogger(__name__)


def report(cfg: DictConfig) -> dict[str, float]:
    """Write a sweep's tables and page again, from what its runs left; print the tables, return nothing.

    Args:
        cfg: The composed configuration; `task.directory` is the sweep's directory, which holds `sweep.json`: null for
            the last one that changed below `output_dir/sweeps`.

    Raises:
        FileNotFoundError: There is no such sweep.
    """
    sweeps = Path(cfg.paths.output_dir) / "sweeps"
    if cfg.task.directory is not None:
        index = Path(cfg.task.directory) / layout.SWEEP
    else:
        index = max(sweeps.glob(f"*/{layout.SWEEP}"), key=lambda path: path.stat().st_mtime, default=sweeps)
    if not index.is_file():
        known = ", ".join(sorted(path.parent.name for path in sweeps.glob(f"*/{layout.SWEEP}"))) or "none"
        raise FileNotFoundError(
            f"task.directory: no sweep in '{index.parent if cfg.task.directory else sweeps}' (known: {known}); run "
            "one, python run.py sweep=table_3_2, or name its directory with task.directory=DIRECTORY"
        )
    written = write_report(index.parent)
    print(written.text)
    _LOG.info("%s", "\n".join(map(str, written.paths)))
    return {}
