"""Imports of optional packages, with the fix in the error when one is missing."""

import os
from typing import Any


def import_open3d() -> Any:
    """The `open3d` module.

    Raises:
        ImportError: It, or a system library that it loads, is missing; the message says what to install.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ImportError(
            f"Open3D cannot be loaded ({error}). Install it with `pip install -e '.[open3d]'` and the system "
            "libraries libusb-1.0-0, libegl1 and libgl1; or do without it: "
            "data.observation.normals=knn (the same normals) or window, data.synthesis.renderer=zbuffer"
        ) from error
    return open3d


def import_pyrender() -> Any:
    """The `pyrender` module, set up to draw through EGL, without a display.

    Raises:
        ImportError: It, or a system library that it loads, is missing; the message says what to install.
    """
    # pyrender reads these when it is imported; what the user has chosen stays.
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    os.environ.setdefault("PYGLET_HEADLESS", "true")
    try:
        import pyrender
    except (ImportError, OSError, AttributeError) as error:
        raise ImportError(
            f"pyrender cannot be loaded ({error}). Install it with `pip install -e '.[pyrender]'` and the system "
            "libraries libegl1, libgl1 and libxrender1; or do without it: data.synthesis.renderer=zbuffer"
        ) from error
    return pyrender
