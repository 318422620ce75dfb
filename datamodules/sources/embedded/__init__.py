"""The embedded source: new poses, recombined from real clips or drawn from procedural families, within human limits.

Everything below works in SMPL's own axes (y up, z forward, x to the body's left), on rotation matrices
`(n, 24, 3, 3)` relative to the parent joint, in float64. Angles of people are in degrees, as the literature has them.
"""

from datamodules.sources.embedded.source import EmbeddedSource

__all__ = ["EmbeddedSource"]
