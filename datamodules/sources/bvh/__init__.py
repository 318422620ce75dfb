"""BVH files: read (`file`), brought to SMPL's joints (`retargeting`) by a table of names (`skeleton`), as a source."""

from datamodules.sources.bvh.source import BvhSource

__all__ = ["BvhSource"]
