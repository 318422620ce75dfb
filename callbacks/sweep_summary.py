"""A sweep's results side by side: on the terminal, as JSON and as a picture."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from ljn.tasks.records import read_json, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOG = logging.getLogger(__name__)
_INITIAL = "initial"


class SweepSummary(Callback):
    """Hydra callback: gathers the metrics of a sweep's runs.

    Each job leaves a note in Hydra's sweep directory, since jobs may run in processes of their own; at the end
    the notes become `summary.json` (`NAME_mpjpe` for each row, mm) and `report.png`.

    Args:
        directory: Where the summary goes.
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Note where the job's run is."""
        assert job_return.cfg is not None
        run_dir = job_return.cfg.paths.run_dir
        note = {
            "name": str(job_return.cfg.name),
            "run_dir": run_dir,
            "is_complete": job_return.status == JobStatus.COMPLETED,
        }
        notes = Path(config.hydra.sweep.dir) / "jobs"
        notes.mkdir(parents=True, exist_ok=True)
        write_json(notes / f"{int(config.hydra.job.num):04d}.json", note)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the table, write the files."""
        notes = [
            read_json(path) or {} for path in sorted((Path(config.hydra.sweep.dir) / "jobs").glob("*.json"))
        ]
        complete = [note for note in notes if note.get("is_complete")]
        runs = {
            note["name"].rpartition("/")[2]: (Path(note["run_dir"]), metrics)
            for note in complete
            if (metrics := read_json(Path(note["run_dir"]) / "metrics.json"))
        }
        if not runs:
            return
        rows = {name: metrics["test/mpjpe"] for name, (_, metrics) in runs.items()}
        rows = {_INITIAL: next(iter(runs.values()))[1]["test/initial_mpjpe"], **rows}
        best = min(runs, key=rows.__getitem__)
        pictures = runs[best][0] / "pictures"
        self.directory.mkdir(parents=True, exist_ok=True)
        write_json(self.directory / "summary.json", {f"{name}_mpjpe": value for name, value in rows.items()})
        report = self.directory / "report.png"
        draw_report(rows, best, pictures / "test_best_median_worst.png").savefig(report)

        print(f"\n{'test MPJPE, mm':16s}")
        for name, value in rows.items():
            pckh = "" if name == _INITIAL else f"   PCKh {runs[name][1]['test/pckh']:5.1f} %"
            print(f"  {name:14s}{value:8.1f}{pckh}")
        print(f"\nreport    {report}\nsummary   {self.directory / 'summary.json'}\npictures  {pictures}")


def draw_report(rows: dict[str, float], best: str, page: Path) -> "Figure":
    """A figure of the rows' MPJPE as bars, over the best row's page of test samples where there is one.

    Args:
        rows: MPJPE by name, mm.
        best: The name to stress.
        page: Picture of test samples.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.image import imread

    picture = imread(page) if page.is_file() else None
    figure = Figure(figsize=(13, 2.6 + (10.4 if picture is not None else 0)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(
        2 if picture is not None else 1, squeeze=False, height_ratios=[1, 5][: 1 + (picture is not None)]
    )
    bars = axes[0, 0]
    names = list(rows)
    drawn = bars.barh(
        names, list(rows.values()), color=["#d62728" if name == best else "#b9bec6" for name in names]
    )
    bars.bar_label(drawn, fmt="%.1f", padding=4)
    bars.invert_yaxis()
    bars.set_xlabel("test MPJPE, mm (lower is better)")
    bars.spines[["top", "right"]].set_visible(False)
    if picture is not None:
        axes[1, 0].imshow(picture)
        axes[1, 0].set_axis_off()
        axes[1, 0].set_title(f"{best}: best, median and worst test samples", loc="left")
    return figure
