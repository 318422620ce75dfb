"""2D joints as a LightningModule: training, validation and test of a keypoint detector (section 4.3.1)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ljn.body.skeleton import NUM_JOINTS
from ljn.data import Batch
from ljn.geometry.camera import project, transfer
from ljn.geometry.heatmaps import gaussian_heatmaps
from ljn.losses import heatmap_loss
from ljn.metrics import KeypointMetrics
from ljn.modules.base import StageModule
from ljn.nets.cpn import CascadedPyramidNetwork, FoundKeypoints
from ljn.nets.resnet import STRIDE
from ljn.reading import READ_ERRORS, reason


class KeypointDetector(StageModule):
    """A keypoint detector (`net`: a `CascadedPyramidNetwork`) with its loss, optimizer and metrics; see `StageModule`.

    Args:
        net: The network.
        optimizer: See `StageModule`.
        scheduler: See `StageModule`.
        target_sigmas: Standard deviations of the target heatmaps, cells: of GlobalNet's four levels from the coarsest
            to the finest, then of RefineNet.
        hard_keypoints: How many joints of a sample, those with the largest loss, RefineNet learns from.
        backbone_weights: File of a state dict of the backbone, such as torchvision's ResNet-50's, that a training
            begins with; None begins at random.

    Raises:
        ValueError: Other than five sigmas, or no such number of joints.
    """

    stage = "keypoints"
    metrics = KeypointMetrics
    net_type: ClassVar[type[nn.Module]] = CascadedPyramidNetwork
    truth = ("joints",)
    stored = ("pred_keypoints", "confidences")
    net: CascadedPyramidNetwork

    def __init__(
        self,
        net: CascadedPyramidNetwork,
        optimizer: Callable[..., Optimizer] | None = None,
        scheduler: Callable[[Optimizer], LRScheduler] | None = None,
        target_sigmas: Sequence[float] = (2.6, 2.0, 1.7, 1.4, 1.4),
        hard_keypoints: int = 11,
        backbone_weights: str | Path | None = None,
    ) -> None:
        super().__init__(net, optimizer, scheduler)
        if len(target_sigmas) != 5 or min(target_sigmas) <= 0:
            raise ValueError(
                f"target_sigmas: expected five positive numbers, cells, got {list(target_sigmas)}"
            )
        if not 1 <= hard_keypoints <= NUM_JOINTS:
            raise ValueError(f"hard_keypoints: expected 1 to {NUM_JOINTS} joints, got {hard_keypoints}")
        self.target_sigmas = tuple(target_sigmas)
        self.hard_keypoints = hard_keypoints
        self.backbone_weights = backbone_weights

    def setup(self, stage: str) -> None:
        """Load the backbone's weights at the start of a training; one that is resumed replaces them."""
        if stage == "fit" and self.backbone_weights is not None:
            load_backbone(self.net.backbone, self.backbone_weights)

    def forward(self, batch: Any) -> FoundKeypoints:
        """The joints in the crops of a batch."""
        return self.net(*self.observation(batch))

    def loss(self, batch: Batch) -> Tensor:
        """See `StageModule.loss` and `heatmap_loss`; joints outside of a crop are not learned from."""
        image, camera = self.observation(batch)
        heatmaps = self.net.heatmaps(self.net.normalised(image))
        keypoints = project(batch["joints"], camera)
        rows, columns = heatmaps[-1].shape[-2:]
        corner = keypoints.new_tensor([STRIDE * columns - 0.5, STRIDE * rows - 0.5])
        is_inside = ((keypoints > -0.5) & (keypoints < corner)).all(-1)
        targets = [
            gaussian_heatmaps(keypoints, sigma, (rows, columns), STRIDE) for sigma in self.target_sigmas
        ]
        return heatmap_loss(heatmaps, targets, is_inside, self.hard_keypoints)

    def evaluate(self, batch: Batch, metrics: Any) -> dict[str, Tensor]:
        """See `StageModule.evaluate`; predicts `pred_keypoints` `(B, 24, 2)`, pixels of the image, and
        `confidences`.
        """
        crop_camera, camera, joints = self.observation(batch)[1], batch["camera"], batch["joints"]
        found = self(batch)
        pred_keypoints = transfer(found.keypoints, crop_camera, camera)
        samples = metrics.update(
            pred_keypoints=pred_keypoints,
            keypoints=project(joints, camera),
            pred_in_crop=found.keypoints,
            in_crop=project(joints, crop_camera),
            confidences=found.confidences,
            joints=joints,
            focal_px=camera[:, 0],
        )
        return {"pred_keypoints": pred_keypoints, "confidences": found.confidences, **samples}


def load_backbone(backbone: nn.Module, path: str | Path) -> None:
    """Load a state dict file into a backbone; a classifier's weights in it (`fc.`) are passed over.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is damaged, or the weights of another network.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"backbone_weights: there is no file '{path}'; give the file of a state dict")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        state = {name: value for name, value in state.items() if not name.startswith("fc.")}
        backbone.load_state_dict(state)
    except (RuntimeError, AttributeError, *READ_ERRORS) as error:  # type: ignore[misc]
        raise ValueError(
            f"backbone_weights: '{path}' is damaged, or does not hold the weights of this backbone "
            f"({reason(error)}); model.backbone's block, depths, widths and in_channels are to be those of the file"
        ) from error
