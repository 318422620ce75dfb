"""Pictures of predictions: of fixed validation samples while training, of the extremes after a test."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.loggers import WandbLogger
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

from callbacks.gathering import gather_samples, join_batches
from ljn.body.skeleton import ROOT
from ljn.data import Batch
from ljn.drawing import CropSample, MeshSample, Sample, clouds, draw_keypoints, draw_meshes, draw_samples
from ljn.geometry.camera import place_at_root, project, transfer
from ljn.metrics.functional import mpjpe
from ljn.runs import layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _never_stops(hook: Callable[..., None]) -> Callable[..., None]:
    """A hook of `Pictures` whose errors of any type become one warning: the run goes on."""

    @wraps(hook)
    def guarded(self: "Pictures", *arguments: Any, **keywords: Any) -> None:
        try:
            hook(self, *arguments, **keywords)
        except Exception as error:
            if not self.has_warned:
                warnings.warn(f"no pictures: {type(error).__name__}: {error}", stacklevel=2)
            self.has_warned = True

    return guarded


class View(ABC):
    """How a stage's samples are looked at: what is kept of each, how bad it is, how it is drawn.

    Attributes:
        inputs: Entries that are drawn of a batch which has them, too large to be kept of every test sample.
    """

    inputs: ClassVar[tuple[str, ...]] = ("points", "crop", "crop_camera")

    @abstractmethod
    def keep(self, outputs: dict[str, Tensor], batch: Any, module: Any) -> dict[str, Tensor]:
        """What a picture needs of a batch beside its `inputs`, small, and `error` `(B,)`, in `unit`."""

    @abstractmethod
    def draw(
        self, samples: dict[str, Tensor], titles: Sequence[str], num_columns: int, module: Any
    ) -> "Figure":
        """A page of samples: the rows of what was kept, and their `inputs`; all on the CPU."""

    def unit(self, module: Any) -> str:
        """What follows an error in a title."""
        return "mm"


class Pictures(Callback):
    """Draws pages of samples, each stage's in its own way (`VIEWS`).

    Files go below `directory`, and to W&B where it is among the loggers. A picture that cannot be drawn warns
    once and never stops a run.

    Args:
        directory: Where pictures go.
        num_samples: Validation samples (the first ones) and test samples of each kind to draw.
        every_n_epochs: Epochs between two validation pictures.
    """

    def __init__(self, directory: str | Path, num_samples: int = 4, every_n_epochs: int = 5) -> None:
        self.directory = Path(directory)
        self.num_samples = num_samples
        self.every_n_epochs = every_n_epochs
        self.has_warned = False
        self._validation: list[dict[str, Tensor]] = []
        self._test: list[dict[str, Tensor]] = []

    @_never_stops
    def on_validation_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: int
    ) -> None:
        """Keep the first samples."""
        missing = self.num_samples - sum(len(samples["error"]) for samples in self._validation)
        is_wanted = trainer.is_global_zero and trainer.state.fn == TrainerFn.FITTING and self._is_due(trainer)
        if not is_wanted or missing <= 0:
            return
        view = _view(pl_module)
        values = {name: batch[name] for name in ("sample_id", *view.inputs) if name in batch}
        values |= view.keep(outputs, batch, pl_module)
        self._validation.append({name: value[:missing].detach().cpu() for name, value in values.items()})

    @_never_stops
    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw them."""
        batches, self._validation = self._validation, []
        if batches:
            samples = join_batches(batches)
            numbers = [f"sample {int(number)}" for number in samples["sample_id"]]
            figure = _page(samples, numbers, self.num_samples, pl_module)
            self._save(trainer, figure, "val/samples", f"val_epoch_{trainer.current_epoch + 1:03d}.png")

    @_never_stops
    def on_test_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, *_: int
    ) -> None:
        """Keep something of every sample."""
        values = _view(pl_module).keep(outputs, batch, pl_module) | {"sample_id": batch["sample_id"]}
        self._test.append({name: value.detach().cpu() for name, value in values.items()})

    @_never_stops
    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Draw the best, the median and the worst samples on a page."""
        batches, self._test = self._test, []
        samples = gather_samples(batches)
        if not samples or not trainer.is_global_zero:
            return
        order = samples["error"].nan_to_num(nan=torch.inf).argsort().tolist()
        number = min(self.num_samples, len(order))
        middle = (len(order) - number) // 2
        kinds = {"best": order[:number], "median": order[middle : middle + number], "worst": order[-number:]}
        chosen = [index for indices in kinds.values() for index in indices]
        drawn = {name: value[chosen] for name, value in samples.items()}
        read: Any = trainer.test_dataloaders
        again = read.dataset.__getitems__(drawn["sample_id"].tolist())
        drawn |= {name: again[name] for name in _view(pl_module).inputs if name in again}
        names = [kind for kind, indices in kinds.items() for _ in indices]
        figure = _page(drawn, names, number, pl_module)
        self._save(trainer, figure, "test/extremes", layout.EXTREMES)

    def _is_due(self, trainer: Trainer) -> bool:
        epoch = trainer.current_epoch + 1
        return epoch % self.every_n_epochs == 0 or epoch in (1, trainer.max_epochs)

    def _save(self, trainer: Trainer, figure: "Figure", key: str, name: str) -> None:
        self.directory.mkdir(parents=True, exist_ok=True)
        path = self.directory / name
        figure.savefig(path)
        for logger in trainer.loggers:
            if isinstance(logger, WandbLogger):
                logger.log_image(key, [str(path)])


class JointView(View):
    """Clouds with true (blue) and predicted (red) skeletons, from the front and from the side; see `View`.

    Joints that are only defined relative to the root are moved to the true root first.
    """

    def keep(self, outputs: dict[str, Tensor], batch: Batch, module: Any) -> dict[str, Tensor]:
        """See `View.keep`."""
        pred_joints, joints = outputs["pred_joints"], batch["joints"]
        if module.is_root_relative:
            pred_joints = pred_joints + (joints - pred_joints)[:, ROOT, None]
        return {"error": mpjpe(pred_joints, joints), "pred_joints": pred_joints, "joints": joints}

    def unit(self, module: Any) -> str:
        """See `View.unit`."""
        return "mm, root-aligned" if module.is_root_relative else "mm"

    def draw(
        self, samples: dict[str, Tensor], titles: Sequence[str], num_columns: int, module: Any
    ) -> "Figure":
        """See `View.draw`."""
        joints, pred_joints = samples["joints"].numpy(), samples["pred_joints"].numpy()
        rows = zip(clouds(samples), joints, pred_joints, titles)
        return draw_samples([Sample(*row) for row in rows], num_columns)


class MeshView(View):
    """Predicted (red) beside true (blue) meshes with the cloud over them, front and side; see `View`."""

    def keep(self, outputs: dict[str, Tensor], batch: Batch, module: Any) -> dict[str, Tensor]:
        """See `View.keep`: parameters and roots, from which the meshes are made again."""
        roots = {"pred_root": outputs["pred_joints"][:, ROOT], "root": batch["joints"][:, ROOT]}
        parameters = {name: outputs[name] for name in ("pred_pose", "pred_betas")}
        truth = {"pose": batch["pose"], "betas": batch["betas"], "gender": batch["gender"]}
        return {"error": outputs["apve"], **parameters, **truth, **roots}

    @torch.no_grad()
    def draw(
        self, samples: dict[str, Tensor], titles: Sequence[str], num_columns: int, module: Any
    ) -> "Figure":
        """See `View.draw`."""
        on_device = {name: value.to(module.device) for name, value in samples.items()}
        meshes = []
        for layer, names, root in (
            (module.target_body, ("pose", "betas", "gender"), "root"),
            (module.body, ("pred_pose", "pred_betas"), "pred_root"),
        ):
            vertices, joints = layer(*(on_device[name] for name in names))
            meshes.append(place_at_root(vertices, joints[:, ROOT], on_device[root]).cpu().numpy())
        rows = zip(clouds(samples), *meshes, titles)
        return draw_meshes([MeshSample(*row) for row in rows], module.body.faces.cpu().numpy(), num_columns)


class KeypointView(View):
    """Crops with true (blue) and predicted (red) 2D skeletons; see `View`."""

    inputs = ("rgb", "crop")

    def keep(self, outputs: dict[str, Tensor], batch: Batch, module: Any) -> dict[str, Tensor]:
        """See `View.keep`."""
        crop_camera = module.observation(batch)[1]
        return {
            "error": outputs["crop_error_px"],
            "pred_keypoints": transfer(outputs["pred_keypoints"], batch["camera"], crop_camera),
            "keypoints": project(batch["joints"], crop_camera),
        }

    def unit(self, module: Any) -> str:
        """See `View.unit`."""
        return "px"

    def draw(
        self, samples: dict[str, Tensor], titles: Sequence[str], num_columns: int, module: Any
    ) -> "Figure":
        """See `View.draw`."""
        images = samples["rgb"].permute(0, 2, 3, 1) if "rgb" in samples else samples["crop"]
        keypoints, pred_keypoints = samples["keypoints"].numpy(), samples["pred_keypoints"].numpy()
        rows = zip(images.numpy(), keypoints, pred_keypoints, titles)
        return draw_keypoints([CropSample(*row) for row in rows], num_columns)


VIEWS: dict[str, View] = {"detector": JointView(), "mesh": MeshView(), "keypoints": KeypointView()}
"""By stage."""


def _view(module: Any) -> View:
    return VIEWS[module.stage]


def _page(samples: dict[str, Tensor], names: Sequence[str], num_columns: int, module: Any) -> "Figure":
    view, errors = _view(module), samples["error"].tolist()
    titles = [f"{name}: {error:.0f} {view.unit(module)}" for name, error in zip(names, errors)]
    return view.draw(samples, titles, num_columns, module)
