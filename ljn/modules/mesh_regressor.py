"""Stage 2 as a LightningModule: training, validation and test of a mesh regressor."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ljn.body import SMPL, load_body_models
from ljn.body.skeleton import ROOT
from ljn.cloud.observation import PARTS
from ljn.data import Batch
from ljn.geometry.camera import place_at_root
from ljn.geometry.rotations import rotmat_to_rotvec
from ljn.losses import check_loss, mesh_loss
from ljn.metrics import MeshMetrics, RefinedMeshMetrics
from ljn.modules.base import StageModule
from ljn.nets.body_network import BodyNetwork
from ljn.refinement import Refiner, refine
from ljn.refinement.looks import Detect

_SEED = 0  # of the choice of the loss's vertices


class MeshRegressor(StageModule):
    """A mesh regressor with its loss on meshes (Eq. 3.7), optimizer and metrics.

    The target is the mesh of the record's gender, the prediction always that of one body; the error that this
    alone leaves is `floor_apve`.

    Args:
        net: The network.
        optimizer: See `StageModule`.
        scheduler: See `StageModule`.
        body_path: SMPL-format file or folder; see `ljn.body.load_body_models`.
        genders: Genders of the records.
        predicted: Gender of the body that predictions are meshes of.
        loss: One of `ljn.losses.LOSSES`.
        loss_vertices: Vertices that the loss is taken over, drawn once from the body's, always the same; None for all.
        joint_weight: Weight of the same loss of the mesh's joints, beside the vertices'.
    """

    stage = "mesh"
    metrics = MeshMetrics
    net_type = BodyNetwork
    truth = ("joints",)
    stored = ("initial_joints", "pred_joints", "pred_pose", "pred_betas")
    net: BodyNetwork

    def __init__(
        self,
        net: BodyNetwork,
        optimizer: Callable[..., Optimizer] | None = None,
        scheduler: Callable[[Optimizer], LRScheduler] | None = None,
        body_path: str | Path | None = None,
        genders: Sequence[str] = ("female", "male"),
        predicted: str = "neutral",
        loss: str = "squared",
        loss_vertices: int | None = None,
        joint_weight: float = 0.0,
    ) -> None:
        super().__init__(net, optimizer, scheduler)
        self.kind_of_loss = check_loss(loss)
        if not 0 <= joint_weight < math.inf:
            raise ValueError(f"joint_weight: expected a number of 0 or more, got {joint_weight}")
        self.joint_weight = joint_weight
        self.body = SMPL(load_body_models(body_path, [predicted]))
        self.target_body = SMPL(load_body_models(body_path, list(genders)))
        net.use_body(self.body)
        self.refiner: Refiner | None = None
        self.detect: Detect | None = None
        self.loss_bodies = nn.ModuleList([self.body, self.target_body])
        if loss_vertices is not None:
            if not 1 <= loss_vertices <= self.body.num_vertices:
                raise ValueError(
                    f"loss_vertices: expected 1 to {self.body.num_vertices}, got {loss_vertices}; null takes all"
                )
            # Drawn, not every n-th: a mesh may number its vertices limb by limb, left and right in turn.
            order = torch.randperm(self.body.num_vertices, generator=torch.Generator().manual_seed(_SEED))
            chosen = order[:loss_vertices].sort().values
            self.loss_bodies = nn.ModuleList(
                body.on_vertices(chosen) for body in (self.body, self.target_body)
            )

    def refine_with(self, refiner: Refiner, detect: Detect | None = None) -> None:
        """Fit the meshes of every evaluation to the depth, too: metrics `refined_*` beside the others.

        A batch then has to hold what the refiner takes.

        Args:
            refiner: What fits, of the predicted body.
            detect: The `second_look` of the detector whose joints the batches hold.
        """
        self.refiner, self.detect = refiner, detect
        self.metrics = RefinedMeshMetrics  # type: ignore[misc]
        self.val_metrics = RefinedMeshMetrics(prefix="val/")
        self.test_metrics = RefinedMeshMetrics(prefix="test/")

    @property
    def observes(self) -> tuple[str, ...]:
        """What of an observation an evaluation takes: the network and, where there is one, the refiner."""
        return tuple(dict.fromkeys((*self.takes, *(self.refiner.takes if self.refiner else ()))))

    @property
    def body_hashes(self) -> tuple[str, ...]:
        """See `StageModule.body_hashes`."""
        return (self.body.hash,)

    def target(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """True vertices `(B, V, 3)` and joints `(B, 24, 3)`, metres, body frame."""
        with torch.no_grad():
            return self.target_body(batch["pose"], batch["betas"], batch["gender"])

    def loss(self, batch: Batch) -> Tensor:
        """See `StageModule.loss`."""
        body, target_body = cast(list[SMPL], list(self.loss_bodies))
        vertices, joints = body.from_rotmats(*self(batch))
        with torch.no_grad():
            target_vertices, target_joints = target_body(batch["pose"], batch["betas"], batch["gender"])
        loss = mesh_loss(vertices, target_vertices, self.kind_of_loss)
        if self.joint_weight:
            loss = loss + self.joint_weight * mesh_loss(joints, target_joints, self.kind_of_loss)
        return loss

    def evaluate(self, batch: Batch, metrics: Any) -> dict[str, Tensor]:
        """See `StageModule.evaluate`.

        Predicts, all for the last iteration, `pred_vertices` `(B, V, 3)`, `pred_joints` `(B, 24, 3)` and gives
        `vertices` (the truth), in the camera frame, metres, the prediction placed at the initial root (Eq. 4.2);
        `pred_pose` `(B, 72)` and `pred_betas` `(B, 10)`.
        """
        rotmats, betas = (values[-1] for values in self(batch))
        pred_vertices, pred_joints = self.body.from_rotmats(rotmats, betas)
        vertices, joints = self.target(batch)
        refined = self._refined(batch, rotmats, betas) if self.refiner else {}
        samples = metrics.update(
            pred_vertices=pred_vertices,
            vertices=vertices,
            pred_body_joints=pred_joints,
            body_joints=joints,
            floor_vertices=self._floor(batch),
            initial_joints=batch["initial_joints"],
            joints=batch["joints"],
            **refined,
        )
        pred_root, initial_root = pred_joints[:, ROOT], batch["initial_joints"][:, ROOT]
        return {
            "pred_vertices": place_at_root(pred_vertices, pred_root, initial_root),
            "pred_joints": place_at_root(pred_joints, pred_root, initial_root),
            "vertices": place_at_root(vertices, joints[:, ROOT], batch["joints"][:, ROOT]),
            "pred_pose": rotmat_to_rotvec(rotmats).flatten(-2),
            "pred_betas": betas,
            **samples,
        }

    def _refined(self, batch: Batch, rotmats: Tensor, betas: Tensor) -> dict[str, Tensor]:
        """What `RefinedMeshMetrics` takes of the refined meshes."""
        assert self.refiner is not None
        joints = batch["initial_joints"]
        tensors = cast(Mapping[str, Tensor], batch)
        seen = {name: tensors[name] for name in PARTS if name in tensors}
        if "lifted_joints" in batch:
            seen["initial_joints"] = batch["lifted_joints"]

        def regress(observations: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
            values = self(observations)
            return values[0][-1], values[1][-1]

        refined, _ = refine(self.refiner, seen, joints, (rotmats, betas), self.detect, regress)
        vertices, body_joints = self.body.from_rotmats(refined.rotmats, refined.betas)
        return {
            "refined_vertices": vertices,
            "refined_body_joints": body_joints,
            "refined_camera_root": refined.root,
        }

    def _floor(self, batch: Batch) -> Tensor:
        """Vertices of the predicted body in the true pose, its shape fitted to the true one's rest mesh."""
        betas = batch["betas"]
        rest = self.target_body(torch.zeros_like(batch["pose"]), betas, batch["gender"]).vertices
        return self.body(batch["pose"], self.body.fit_betas(rest)).vertices
