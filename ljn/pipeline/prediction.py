"""What is found of one person: joints, mesh, parameters, and what was done about the input."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from ljn.pipeline.report import Report


@dataclass(frozen=True)
class Prediction:
    """What is found of one person, or, with a leading dimension B, of a batch; camera frame, metres, float32.

    Attributes:
        joints: `(24, 3)`, the joint detector's.
        points: `(N, 6)`, the cloud: position and normal.
        initial_joints: `(24, 3)`, the keypoints lifted with the depth image.
        keypoints: `(24, 2)`, those of the SMPL joints, pixels.
        confidences: `(24,)`, the keypoints' own, from 0 to 1; 0 where a keypoint was filled in.
        vertices: `(V, 3)`, the mesh, its root joint at the detector's (Eq. 4.1-4.2).
        pose: `(72,)` axis-angle, radians; the first three turn SMPL's rest frame into body world, as in `Batch`.
        betas: `(10,)`.
        global_orient: `(3,)` axis-angle, radians, in the camera's axes. It, the body's pose `pose[3:]`, `betas` and
            `transl` give any SMPL layer the same vertices in the camera frame.
        transl: `(3,)`, the translation of an SMPL layer.
        faces: `(F, 3)` int64, vertex indices; of a batch, too.
        mesh_joints: `(24, 3)`, the mesh's own joints.
        is_refined: Whether mesh, pose and shape are fitted to the depth; false where the fit was given up.
        residual_mm: `(2,)`, median distance of the cloud's points to the mesh, as guessed and as returned.
        report: What was found in the input, and done about it; of a batch, one for each image.

    Without keypoints, `initial_joints`, `keypoints` and `confidences` are None; without a mesh regressor, `vertices`,
    `pose`, `betas`, `global_orient`, `transl`, `faces` and `mesh_joints`; without refinement, `is_refined` and
    `residual_mm`. With it, the mesh is placed where it fits, and `joints` are those that the fit began with.
    """

    joints: np.ndarray
    points: np.ndarray
    initial_joints: np.ndarray | None = None
    keypoints: np.ndarray | None = None
    confidences: np.ndarray | None = None
    vertices: np.ndarray | None = None
    pose: np.ndarray | None = None
    betas: np.ndarray | None = None
    faces: np.ndarray | None = None
    mesh_joints: np.ndarray | None = None
    is_refined: np.ndarray | None = None
    residual_mm: np.ndarray | None = None
    global_orient: np.ndarray | None = None
    transl: np.ndarray | None = None
    report: Report | tuple[Report, ...] = ()

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All arrays that there are, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def __getitem__(self, index: int) -> Self:
        """One of a batch."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        chosen = {
            name: value if value is None or name == "faces" or len(value) == 0 else value[index]
            for name, value in values.items()
        }
        return type(self)(**chosen)
