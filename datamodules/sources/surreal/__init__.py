"""SURREAL (Varol et al. 2017): its poses and shapes, its own depth images and colour frames, and the check of its world
and camera.
"""

from datamodules.sources.surreal.colour import SurrealRgbSource
from datamodules.sources.surreal.depth import SurrealDepthSource
from datamodules.sources.surreal.source import SurrealSource

__all__ = ["SurrealDepthSource", "SurrealRgbSource", "SurrealSource"]
