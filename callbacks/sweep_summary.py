"""A sweep's results side by side: on the terminal, as JSON and as a picture."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from ljn.drawing import new_figure
from ljn.tasks.records import read_json, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INITIAL = "initial"


class SweepSummary(Callback):
    """Hydra callback: gathers the metrics of a sweep's runs, after every job, so that a failure costs no result.

    Each job leaves a note in Hydra's sweep directory, since jobs may run in processes of their own; the notes
    become `summary.json` (`NAME_mpjpe` for each row, mm; null for a job that failed), `report.png` and a table on
    the terminal.

    Args:
        directory: Where the summary goes.
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Remove an earlier sweep's summary."""
        for name in ("summary.json", "report.png"):
            (self.directory / name).unlink(missing_ok=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Note where the job's run is; sum up what there is."""
        assert job_return.cfg is not None
        notes = Path(config.hydra.sweep.dir) / "jobs"
        notes.mkdir(parents=True, exist_ok=True)
        note = {
            "name": str(job_return.cfg.name).rpartition("/")[2],
            "run_dir": job_return.cfg.paths.run_dir,
            "is_complete": job_return.status == JobStatus.COMPLETED,
        }
        write_json(notes / f"{int(config.hydra.job.num):04d}.json", note)
        self._sum_up([read_json(path) or {} for path in sorted(notes.glob("*.json"))])

    def _sum_up(self, notes: list[dict[str, Any]]) -> None:
        rows: dict[str, dict[str, float] | None] = {}
        directories: dict[str, Path] = {}
        for note in notes:
            number = sum(name.partition("#")[0] == note["name"] for name in rows)
            name = note["name"] if number == 0 else f"{note['name']}#{number + 1}"
            directories[name] = Path(note["run_dir"] or ".")
            rows[name] = read_json(directories[name] / "metrics.json") if note["is_complete"] else None
        done = {name: metrics for name, metrics in rows.items() if metrics is not None}
        values: dict[str, float | None] = {}
        if done:
            values[_INITIAL] = next(iter(done.values()))["test/initial_mpjpe"]
        values |= {name: metrics["test/mpjpe"] if metrics else None for name, metrics in rows.items()}
        self.directory.mkdir(parents=True, exist_ok=True)
        write_json(
            self.directory / "summary.json", {f"{name}_mpjpe": value for name, value in values.items()}
        )

        print(f"\n{'test MPJPE, mm':16s}")
        for name, value in values.items():
            pckh = f"   PCKh {done[name]['test/pckh']:5.1f} %" if name in done else ""
            print(f"  {name:14s}" + (f"{value:8.1f}{pckh}" if value is not None else "  failed"))
        if done:
            best = min(done, key=lambda name: done[name]["test/mpjpe"])
            pictures = directories[best] / "pictures"
            report = self.directory / "report.png"
            known = {name: value for name, value in values.items() if value is not None}
            draw_report(known, best, pictures / "test_best_median_worst.png").savefig(report)
            print(f"\nreport    {report}\nsummary   {self.directory / 'summary.json'}\npictures  {pictures}")
        print(flush=True)


def draw_report(rows: dict[str, float], best: str, page: Path) -> "Figure":
    """A figure of the rows' MPJPE as bars, over the best row's page of test samples where there is one.

    Args:
        rows: MPJPE by name, mm.
        best: The name to stress.
        page: Picture of test samples.
    """
    from matplotlib.image import imread

    picture = imread(page) if page.is_file() else None
    width, heights = 12.0, [0.8 + 0.35 * len(rows)]
    if picture is not None:
        heights.append(0.3 + width * picture.shape[0] / picture.shape[1])
    figure = new_figure(width, sum(heights))
    axes = figure.subplots(len(heights), squeeze=False, height_ratios=heights)
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
