"""Imports of optional packages, with the fix in the error when one is missing."""

import os
from importlib import import_module
from typing import Any


def _import(name: str, fix: str) -> Any:
    try:
        return import_module(name)
    except (ImportError, OSError, AttributeError) as error:
        raise ImportError(f"{name} cannot be loaded ({error}). Install it with `pip install {fix}") from error


def import_open3d() -> Any:
    """The `open3d` module; an `ImportError` where it, or a system library that it loads, is missing."""
    fix = (
        "-e '.[open3d]'` and the system libraries libusb-1.0-0, libegl1 and libgl1; or do without it: "
        "data.observation.normals=knn (the same normals) or window, data.synthesis.renderer=zbuffer"
    )
    return _import("open3d", fix)


def import_huggingface_hub() -> Any:
    """The `huggingface_hub` module; an `ImportError` where it is missing."""
    return _import(
        "huggingface_hub", "huggingface_hub` (the extra `hub`); or give a package's file, NAME.safetensors"
    )


def import_h5py() -> Any:
    """The `h5py` module; an `ImportError` where it is missing."""
    fix = "h5py` (the extra `hdf5`), which MATLAB's files of version 7.3 need; or save them with -v7"
    return _import("h5py", fix)


def import_pyrender() -> Any:
    """The `pyrender` module, set up to draw through EGL, without a display; an `ImportError` as `import_open3d`."""
    # pyrender reads these when it is imported; what the user has chosen stays.
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    os.environ.setdefault("PYGLET_HEADLESS", "true")
    fix = (
        "-e '.[pyrender]'` and the system libraries libegl1, libgl1 and libxrender1; or do without it: "
        "data.synthesis.renderer=zbuffer"
    )
    return _import("pyrender", fix)


def import_viser() -> Any:
    """The `viser` module; an `ImportError` where it is missing."""
    return _import("viser", "-e '.[view]'`; or do without the live view: task.view=false")


def import_driver(name: str, extra: str, needs: str = "") -> Any:
    """The module of a sensor's driver; an `ImportError` where it is missing.

    Args:
        name: The module.
        extra: The extra that installs it.
        needs: What it needs beside.
    """
    more = f". {needs}" if needs else ""
    return _import(name, f"-e '.[{extra}]'`{more}; or replay a recording with live:replay:PATH")
