"""The mesh regressor's metrics (section 3.7.2)."""

from typing import ClassVar

from torch import Tensor

from ljn.body.skeleton import ROOT
from ljn.geometry.camera import place_at_root
from ljn.metrics import functional
from ljn.metrics.samples import Quantity, SampleMax, StageMetrics

_MESHES = ("pred_vertices", "vertices")
_SKELETONS = ("pred_body_joints", "body_joints")
_INITIAL = ("initial_joints", "joints")


class MeshMetrics(StageMetrics):
    """Every metric of the mesh regressor under its key, for one split; see `StageMetrics`.

    Vertices and the mesh's joints are in the body frame, and for `*_camera` in the camera frame, placed at the initial
    root (Eq. 4.2). `floor_apve` is of the true pose on the predicted body, at the shape nearest to the true one.
    """

    table: ClassVar = {
        "apve": Quantity(functional.apve, _MESHES),
        "mpjpe": Quantity(functional.mpjpe, _SKELETONS),
        "mpjpe_eq38": Quantity(functional.mpjpe_eq38, _SKELETONS),
        "apve_root_aligned": Quantity(functional.apve_root_aligned, (*_MESHES, "pred_root", "root")),
        "apve_procrustes": Quantity(functional.apve_procrustes, _MESHES),
        "apve_camera": Quantity(functional.apve, ("pred_vertices_camera", "vertices_camera")),
        "mpjpe_camera": Quantity(functional.mpjpe, ("pred_body_joints_camera", "body_joints_camera")),
        "floor_apve": Quantity(functional.apve, ("floor_vertices", "vertices")),
        "initial_mean_distance_mm": Quantity(functional.joint_errors_mm, _INITIAL, goal=None),
        "initial_max_distance_mm": Quantity(
            functional.joint_errors_mm, _INITIAL, goal=None, reduction=SampleMax
        ),
    }
    headline = ("apve", "mpjpe")

    def update(  # type: ignore[override]
        self,
        pred_vertices: Tensor,
        vertices: Tensor,
        pred_body_joints: Tensor,
        body_joints: Tensor,
        floor_vertices: Tensor,
        initial_joints: Tensor,
        joints: Tensor,
        **more: Tensor,
    ) -> dict[str, Tensor]:
        """Add a batch, metres; see `StageMetrics.update`.

        Args:
            pred_vertices: `(B, V, 3)`, body frame.
            vertices: `(B, V, 3)`, body frame, the truth.
            pred_body_joints: `(B, 24, 3)`, body frame.
            body_joints: `(B, 24, 3)`, body frame, the truth.
            floor_vertices: `(B, V, 3)`, body frame: the nearest that the predicted body comes to the truth.
            initial_joints: `(B, 24, 3)`, camera frame.
            joints: `(B, 24, 3)`, camera frame, the truth.
            more: What other quantities of the table take, as it comes.
        """
        tensors = more | {
            "pred_vertices": pred_vertices,
            "vertices": vertices,
            "pred_body_joints": pred_body_joints,
            "body_joints": body_joints,
            "floor_vertices": floor_vertices,
            "initial_joints": initial_joints,
            "joints": joints,
            "pred_root": pred_body_joints[:, ROOT],
            "root": body_joints[:, ROOT],
        }
        for names, root, camera_root in (
            (("pred_vertices", "pred_body_joints"), "pred_root", initial_joints[:, ROOT]),
            (("vertices", "body_joints"), "root", joints[:, ROOT]),
        ):
            for name in names:
                placed = (tensors[name], tensors[root], camera_root)
                tensors[f"{name}_camera"] = place_at_root(*(value.double() for value in placed))
        return super().update(**tensors)


_REFINED = ("refined_vertices", "vertices")


class RefinedMeshMetrics(MeshMetrics):
    """The same, and under `refined_*` those of meshes that were fitted to the depth, placed where they fit."""

    table: ClassVar = {
        **MeshMetrics.table,
        "refined_apve": Quantity(functional.apve, _REFINED),
        "refined_mpjpe": Quantity(functional.mpjpe, ("refined_body_joints", "body_joints")),
        "refined_apve_root_aligned": Quantity(
            functional.apve_root_aligned, (*_REFINED, "refined_root", "root")
        ),
        "refined_apve_procrustes": Quantity(functional.apve_procrustes, _REFINED),
        "refined_apve_camera": Quantity(functional.apve, ("refined_vertices_camera", "vertices_camera")),
        "refined_mpjpe_camera": Quantity(
            functional.mpjpe, ("refined_body_joints_camera", "body_joints_camera")
        ),
        "refined_harmed": Quantity(
            functional.harmed, ("pred_vertices_camera", "refined_vertices_camera", "vertices_camera"), "%"
        ),
    }

    def update(  # type: ignore[override]
        self,
        refined_vertices: Tensor,
        refined_body_joints: Tensor,
        refined_camera_root: Tensor,
        **tensors: Tensor,
    ) -> dict[str, Tensor]:
        """Add a batch, metres; see `MeshMetrics.update`.

        Args:
            refined_vertices: `(B, V, 3)`, body frame.
            refined_body_joints: `(B, 24, 3)`, body frame.
            refined_camera_root: `(B, 3)`, the refined body's root, camera frame.
            tensors: What `MeshMetrics.update` takes.
        """
        root = refined_body_joints[:, ROOT]
        refined = {"refined_vertices": refined_vertices, "refined_body_joints": refined_body_joints}
        placed = {
            f"{name}_camera": place_at_root(value.double(), root.double(), refined_camera_root.double())
            for name, value in refined.items()
        }
        return super().update(**tensors, **refined, **placed, refined_root=root)
