"""How far a pose's body parts reach into each other, on every skeleton that poses are tested on."""

from torch import Tensor

from datamodules.sources.penetration import fit_capsules, penetration
from datamodules.sources.reference import REFERENCE_CAPSULES, REFERENCE_OFFSETS
from ljn.body import BodyModel
from ljn.body.kinematics import joint_offsets, world_rotations


class Clearance:
    """Measures poses on a body's mean shape and on the reference skeleton."""

    def __init__(self, body: BodyModel) -> None:
        self.hash = body.hash
        self.offsets = joint_offsets(body)
        self._capsules = fit_capsules(body)

    def depth(self, rotmat: Tensor) -> Tensor:
        """The deepest penetration of poses `(n, 24, 3, 3)` on either: `(n,)`, metres; below zero, parts are apart."""
        world = world_rotations(rotmat)
        on_body = penetration(world, self.offsets, self._capsules).amax(1)
        return on_body.maximum(penetration(world, REFERENCE_OFFSETS, REFERENCE_CAPSULES).amax(1))
