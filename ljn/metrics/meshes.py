"""The mesh regressor's metrics (section 3.7.2) as torchmetrics, right under DDP and any split into batches."""

from torch import Tensor
from torchmetrics import MetricCollection

from ljn.body.skeleton import ROOT
from ljn.geometry.camera import place_at_root
from ljn.metrics import functional
from ljn.metrics.joints import MPJPE, MPJPEEq38, SampleMax, SampleMean


class APVE(SampleMean):
    """Eq. 3.9, mean error over all vertices, mm; see `functional.apve`."""

    formula = staticmethod(functional.apve)


class RootAlignedAPVE(SampleMean):
    """Mean error over all vertices with the roots made to coincide, mm; see `functional.apve_root_aligned`."""

    formula = staticmethod(functional.apve_root_aligned)


class ProcrustesAPVE(SampleMean):
    """Mean error over all vertices after the best similarity transform, mm; see `functional.apve_procrustes`."""

    formula = staticmethod(functional.apve_procrustes)


class MeanJointDistance(SampleMean):
    """Mean distance of the initial joints from the true ones, mm; see `functional.joint_errors_mm`."""

    higher_is_better = None
    formula = staticmethod(functional.joint_errors_mm)


class MaxJointDistance(SampleMax):
    """Maximum distance of an initial joint from the true one, mm; see `functional.joint_errors_mm`."""

    higher_is_better = None
    formula = staticmethod(functional.joint_errors_mm)


class MeshMetrics(MetricCollection):
    """Every metric of the mesh regressor under its key, for one split; all in mm.

    | key                        | of                                                                        |
    |----------------------------|---------------------------------------------------------------------------|
    | `apve`                     | vertices, body frame                                                      |
    | `mpjpe`, `mpjpe_eq38`      | the mesh's joints, body frame                                             |
    | `apve_root_aligned`        | vertices                                                                  |
    | `apve_procrustes`          | vertices                                                                  |
    | `apve_camera`              | vertices, camera frame, placed at the initial root (Eq. 4.2)              |
    | `mpjpe_camera`             | the mesh's joints, likewise                                               |
    | `floor_apve`               | the true pose on the predicted body, at the shape nearest to the true one |
    | `initial_mean_distance_mm` | initial joints                                                            |
    | `initial_max_distance_mm`  | initial joints                                                            |

    Args:
        prefix: put before every key, such as `"val/"`.
    """

    def __init__(self, prefix: str | None = None) -> None:
        super().__init__(
            {
                "apve": APVE(),
                "mpjpe": MPJPE(),
                "mpjpe_eq38": MPJPEEq38(),
                "apve_root_aligned": RootAlignedAPVE(),
                "apve_procrustes": ProcrustesAPVE(),
                "apve_camera": APVE(),
                "mpjpe_camera": MPJPE(),
                "floor_apve": APVE(),
                "initial_mean_distance_mm": MeanJointDistance(),
                "initial_max_distance_mm": MaxJointDistance(),
            },
            prefix=prefix,
            compute_groups=False,  # see `JointMetrics`
        )

    def update(  # type: ignore[override]
        self,
        pred_vertices: Tensor,
        vertices: Tensor,
        pred_body_joints: Tensor,
        body_joints: Tensor,
        floor_vertices: Tensor,
        initial_joints: Tensor,
        joints: Tensor,
    ) -> None:
        """Add a batch; metres.

        Args:
            pred_vertices: `(B, V, 3)`, body frame.
            vertices: `(B, V, 3)`, body frame, the truth.
            pred_body_joints: `(B, 24, 3)`, body frame.
            body_joints: `(B, 24, 3)`, body frame, the truth.
            floor_vertices: `(B, V, 3)`, body frame: the nearest that the predicted body comes to the truth.
            initial_joints: `(B, 24, 3)`, camera frame.
            joints: `(B, 24, 3)`, camera frame, the truth.
        """
        pred_root, root = pred_body_joints[:, ROOT], body_joints[:, ROOT]
        camera_roots = initial_joints[:, ROOT], joints[:, ROOT]
        meshes, skeletons = (pred_vertices, vertices), (pred_body_joints, body_joints)
        arguments: dict[str, tuple[Tensor, ...]] = {
            "apve": meshes,
            "mpjpe": skeletons,
            "mpjpe_eq38": skeletons,
            "apve_root_aligned": (*meshes, pred_root, root),
            "apve_procrustes": meshes,
            "floor_apve": (floor_vertices, vertices),
            "initial_mean_distance_mm": (initial_joints, joints),
            "initial_max_distance_mm": (initial_joints, joints),
        }
        for name, pair in {"apve_camera": meshes, "mpjpe_camera": skeletons}.items():
            placed = zip(pair, (pred_root, root), camera_roots)
            arguments[name] = tuple(place_at_root(*(value.double() for value in values)) for values in placed)
        for key, metric in self.items(keep_base=True):
            metric.update(*arguments[key])
