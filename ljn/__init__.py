"""3D human joints and body meshes from depth images with local joint networks.

Importing this package is cheap: the public names below are loaded when they are first used.
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "Camera": "ljn.geometry.camera",
    "SMPL": "ljn.body.smpl",
    "JointDetector": "ljn.modules.joint_detector",
    "Pipeline": "ljn.pipeline.pipeline",
    "get_renderer": "ljn.render",
}
__all__ = ["SMPL", "Camera", "JointDetector", "Pipeline", "__version__", "get_renderer"]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'ljn' has no attribute '{name}'; public names: {', '.join(__all__)}")
