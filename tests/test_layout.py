"""Data flows one way through the house: a room imports those below it alone."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = (
    "ljn.reading", "ljn.optional", "ljn.geometry", "ljn.body", "ljn.render", "ljn.cloud", "ljn.data", "ljn.drawing",
    "ljn.nets", "ljn.losses", "ljn.metrics", "ljn.refinement", "ljn.modules", "ljn.building", "ljn.runs",
    "ljn.pipeline", "ljn.demo", "ljn.report", "ljn.system", "ljn.benchmark", "ljn.tasks", "ljn.body.build",
    "datamodules", "callbacks", "run",
)  # fmt: skip
"""From the ground up. Only what stands above all of `ljn` may import `datamodules` or `callbacks`."""


def room(module):
    """The room of a module; None for another package's."""
    fits = [name for name in ROOMS if module == name or module.startswith(f"{name}.")]
    return max(fits, key=len, default=None)


def imports(path):
    """The modules that a file imports, inside functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


FILES = [
    ROOT / "run.py",
    *(path for top in ("ljn", "datamodules", "callbacks") for path in (ROOT / top).rglob("*.py")),
]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_import_runs_upwards(path):
    module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    if module == "ljn.__init__":
        pytest.skip("the public names, loaded when they are first used")
    here = room(module)
    assert here is not None, "a new room: give it its place in ROOMS"
    for name in imports(path):
        there = room(name)
        if there is not None and there != here:
            assert ROOMS.index(there) < ROOMS.index(here), f"{here} imports {name}"
            assert (there, here) != ("datamodules", "callbacks")
