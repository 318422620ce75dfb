"""`task=list`: what can be run, from the comments at the head of the configuration's files."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omegaconf import DictConfig

CONF = Path(__file__).parents[2] / "conf"
GROUPS = ("experiment", "sweep", "preset", "bench")


def list_choices(cfg: "DictConfig | None" = None) -> dict[str, float]:
    """Print the experiments, sweeps, presets and benchmarks with a line on each; no metrics come back."""
    for group in GROUPS:
        lines = descriptions(CONF / group)
        width = max(map(len, lines), default=0)
        print(f"{group}=")
        for name, line in lines.items():
            print(f"  {name:{width}s}  {line}".rstrip())
    return {}


def descriptions(directory: Path) -> dict[str, str]:
    """For each YAML file below a directory, by its name in a command, what its first comment says.

    That is the comment's lines up to the end of a sentence, without the package and the command that run it.
    """
    return {
        str(path.relative_to(directory).with_suffix("")): _first_comment(path.read_text(encoding="utf-8"))
        for path in sorted(directory.rglob("*.yaml"))
    }


def _first_comment(text: str) -> str:
    sentence: list[str] = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        comment = line.lstrip("# ").rstrip()
        if comment.startswith("@package") or "python run.py" in comment:
            continue
        sentence.append(comment)
        if comment.endswith("."):
            break
    return " ".join(sentence)
