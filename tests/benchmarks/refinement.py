"""What refinement gains and costs with the weights that ship; makes the covariance that it weighs its guesses with.

    python -m tests.benchmarks.refinement                    # tables of docs/refinement.md, on the embedded test clips
    python -m tests.benchmarks.refinement --samples 250      # the same of every eighth
    python -m tests.benchmarks.refinement --covariance       # writes ljn/refinement/data/guess_errors.npz

Millimetres, in the camera frame without alignment but where said; one thread, processor time.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from torch import Tensor

from ljn.body import SMPL, load_body_models
from ljn.body.skeleton import ROOT
from ljn.building import build
from ljn.cloud.observation import MIRRORED
from ljn.geometry.camera import place_at_root
from ljn.geometry.rotations import CAMERA_FROM_BODY, rotvec_to_rotmat
from ljn.metrics import apve, apve_procrustes, apve_root_aligned, mpjpe
from ljn.pipeline.pipeline import Pipeline
from ljn.refinement import SETTINGS, Refined, Refiner, refine
from ljn.refinement.prior import PATH
from ljn.refinement.surface import BodyState
from ljn.runs.packages import DEFAULT
from ljn.tasks.schema import register

ROOT_DIRECTORY = Path(__file__).parents[2]
CHUNK = 40
KEYPOINTS = {"10 px keypoints": "[0]", "no keypoints": "[1]"}


class Samples(NamedTuple):
    """Samples with what the networks make of them."""

    seen: dict[str, Tensor]
    joints: Tensor
    rotmats: Tensor
    betas: Tensor
    vertices: Tensor  # the truth, camera frame
    true_joints: Tensor
    true_state: BodyState  # on the predicted body


class Chain:
    """The shipped networks."""

    def __init__(self, weights: str) -> None:
        pipeline = Pipeline.from_pretrained(weights)
        assert pipeline.regressor is not None
        self.detector, self.regressor = pipeline.detector.module, pipeline.regressor.module
        self.body: SMPL = self.regressor.body

    def regress(self, seen: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
        """See `ljn.refinement.looks.Regress`."""
        rotmats, betas = (values[-1] for values in self.regressor(seen))
        return rotmats, betas

    @torch.inference_mode()
    def samples(self, split: str, missing: str, step: int) -> Samples:
        """Every `step`-th sample of a fixed set of the detector's own experiment."""
        register()
        with initialize_config_dir(str(ROOT_DIRECTORY / "conf"), version_base=None):
            overrides = [
                "experiment=detector/cascade",
                "preset=small",
                "preset.num_val=1000",
                "data.num_workers=0",
            ]
            cfg = compose("config", [*overrides, f"data.synthesis.missing_keypoints={missing}"])
        data = build(cfg.data)
        data.takes = (*MIRRORED, "keypoints")
        data.prepare_data()
        batch = {name: value[::step] for name, value in data._fixed_samples(split).items()}
        truth_body = SMPL(load_body_models(None, ["female", "male"]))
        parts = []
        for start in range(0, len(batch["pose"]), CHUNK):
            part = {name: value[start : start + CHUNK] for name, value in batch.items()}
            joints = self.detector(part)
            rotmats, betas = self.regress(part | {"initial_joints": joints})
            body = truth_body(part["pose"], part["betas"], part["gender"])
            vertices = place_at_root(body.vertices, body.joints[:, ROOT], part["joints"][:, ROOT])
            rest = truth_body(torch.zeros_like(part["pose"]), part["betas"], part["gender"]).vertices
            turns = rotvec_to_rotmat(part["pose"].unflatten(-1, (24, 3)))
            parts.append((joints, rotmats, betas, vertices, turns, self.body.fit_betas(rest)))
        joints, rotmats, betas, vertices, turns, shapes = map(torch.cat, zip(*parts))
        turns = torch.cat([CAMERA_FROM_BODY.float() @ turns[:, :1], turns[:, 1:]], 1)
        truth = BodyState(turns, shapes, batch["joints"][:, ROOT])
        seen = {name: batch[name] for name in MIRRORED}
        return Samples(seen, joints, rotmats, betas, vertices, batch["joints"], truth)

    @torch.inference_mode()
    def errors(self, samples: Samples, rotmats: Tensor, betas: Tensor, root: Tensor) -> dict[str, Tensor]:
        """Each sample's errors."""
        made: dict[str, list[Tensor]] = {}
        for start in range(0, len(root), CHUNK):
            part = slice(start, start + CHUNK)
            body = self.body.from_rotmats(rotmats[part], betas[part])
            vertices, joints = (place_at_root(value, body.joints[:, ROOT], root[part]) for value in body)
            target, true_joints = samples.vertices[part], samples.true_joints[part]
            aligned = apve_root_aligned(vertices, target, joints[:, ROOT], true_joints[:, ROOT])
            values = {
                "PVE": apve(vertices, target),
                "root-aligned": aligned,
                "Procrustes": apve_procrustes(vertices, target),
                "MPJPE": mpjpe(joints, true_joints),
            }
            for name, value in values.items():
                made.setdefault(name, []).append(value.mean(-1) if value.ndim > 1 else value)
        return {name: torch.cat(values) for name, values in made.items()}


def row(
    name: str, errors: dict[str, Tensor], raw: dict[str, Tensor] | None = None, ms: float | None = None
) -> None:
    """Print mean, median and 90th percentile of each error."""
    cells = [
        f"{value.mean():.1f} / {value.median():.1f} / {value.quantile(0.9):.1f}" for value in errors.values()
    ]
    harmed = "" if raw is None else f"{100 * (errors['PVE'] > raw['PVE'] + 5).double().mean():.1f} %"
    print("|", " | ".join([name, *cells, harmed, "" if ms is None else f"{ms:.0f}"]), "|", flush=True)


def run(chain: Chain, samples: Samples, refiner: Refiner, second_look: bool = True) -> tuple[Refined, float]:
    """The fits, and milliseconds of a frame in batches."""
    start = time.process_time()
    fits, _ = refine(
        *(refiner, samples.seen, samples.joints, (samples.rotmats, samples.betas)),
        *(chain.detector if second_look else None, chain.regress),
    )
    return fits, 1000 * (time.process_time() - start) / len(samples.joints)


def heading(title: str, errors: dict[str, Tensor]) -> None:
    """Print a table's head."""
    print(f"\n{title}: mean / median / 90th percentile")
    print("|", " | ".join(["", *errors, "harmed", "ms"]), "|\n|---" + "|---:" * (len(errors) + 2) + "|")


def tables(weights: str, num_samples: int) -> None:
    """Print the tables: the settings on all samples, and each change alone on some."""
    chain = Chain(weights)
    accurate = SETTINGS["accurate"]
    for tag, missing in KEYPOINTS.items():
        samples = chain.samples("test", missing, max(1, 2000 // num_samples))
        raw = as_guessed(chain, samples)
        heading(f"{tag}, {len(samples.joints)} samples", raw)
        row("as guessed", raw)
        for name, looks in (("fast", True), ("accurate", True), ("accurate", False)):
            fits, ms = run(chain, samples, Refiner(chain.body, name), looks)
            errors = chain.errors(samples, fits.rotmats, fits.betas, fits.root)
            row(name if looks else f"{name}, one look", errors, raw, ms)
            if looks:
                kept, residual = 100 * fits.is_kept.double().mean(), fits.residual_mm.mean(0).tolist()
                far = (100 * fits.unexplained.mean(0)).tolist()
                text = f"kept {kept:.1f} %; residual {residual[0]:.1f} -> {residual[1]:.1f} mm; "
                print(f"<!-- {name}: {text}farther than 5 cm {far[0]:.1f} -> {far[1]:.1f} % -->")

        samples = chain.samples("test", missing, max(1, 2000 // min(num_samples, 250)))
        raw = as_guessed(chain, samples)
        heading(f"{tag}, {len(samples.joints)} samples, one look", raw)
        row("as guessed", raw)
        changes: dict[str, dict[str, Any]] = {
            "accurate": {},
            "1 step": {"num_steps": 1},
            **{f"{steps} steps": {"num_steps": steps} for steps in (2, 4, 20)},
            "256 points": {"num_points": 256},
            "861 vertices": {"num_vertices": 861},
            "points of the cloud: their planes alone": {"vertex_share": 0.0},
            "no outline": {"outline_share": 0.0},
            "a tenth of the guess's weight": {"prior_weight": 0.1},
            "a hundredth": {"prior_weight": 0.01},
            "scale of 1 m: hardly robust": {"scales_m": (1.0, 1.0)},
        }
        for name, change in changes.items():
            fits, ms = run(
                chain, samples, Refiner(chain.body, dataclasses.replace(accurate, **change)), False
            )
            row(name, chain.errors(samples, fits.rotmats, fits.betas, fits.root), raw, ms)
        diagonal = np.diag(np.diag(np.load(PATH)["covariance"]))
        fits, ms = run(chain, samples, Refiner(chain.body, accurate, diagonal), False)
        errors = chain.errors(samples, fits.rotmats, fits.betas, fits.root)
        row("the guess's errors independent of each other", errors, raw, ms)


def as_guessed(chain: Chain, samples: Samples) -> dict[str, Tensor]:
    """The guesses' errors, where their joints lie nearest to the detected ones."""
    root = Refiner(chain.body, "fast").guess(samples.rotmats, samples.betas, samples.joints).root
    return chain.errors(samples, samples.rotmats, samples.betas, root)


def times(weights: str) -> None:
    """Print what a frame costs, alone."""
    chain = Chain(weights)
    samples = chain.samples("test", "[1]", 100)
    print("\n| one frame, ms | " + " | ".join(SETTINGS) + " |\n|---" + "|---:" * len(SETTINGS) + "|")
    costs: dict[str, list[float]] = {}
    for settings in SETTINGS.values():
        refiner = Refiner(chain.body, settings)
        spent: dict[str, float] = {}
        for name in ("_match", "_step", "_explained"):
            _timed(refiner, name, spent)
        for name in ("forward", "rows"):
            _timed(refiner.surface, name, spent)
        frames = range(len(samples.joints))
        for _ in range(2):  # the first compiles
            spent.clear()
            start = time.process_time()
            for frame in frames:
                one = slice(frame, frame + 1)
                seen = {name: value[one] for name, value in samples.seen.items()}
                refiner(seen, samples.rotmats[one], samples.betas[one], samples.joints[one])
            total = time.process_time() - start
        parts = {
            "posing the surface": spent["forward"],
            "nearest vertices": spent["_match"],
            "rows of the Jacobian": spent["rows"],
            "outline, sums and solution": spent["_step"] - spent["rows"],
            "residuals": spent["_explained"],
            "in all": total,
        }
        for name, value in parts.items():
            costs.setdefault(name, []).append(1000 * value / len(frames))
    for name, values in costs.items():
        print("|", " | ".join([name, *(f"{value:.1f}" for value in values)]), "|")


def _timed(owner: object, name: str, spent: dict[str, float]) -> None:
    method = getattr(owner, name)

    def timed(*arguments: object) -> object:
        start = time.process_time()
        made = method(*arguments)
        spent[name] = spent.get(name, 0) + time.process_time() - start
        return made

    object.__setattr__(owner, name, timed)


def make_covariance(weights: str) -> None:
    """Measure the guesses' errors on the validation clips, half with keypoints and half without, and write them."""
    chain = Chain(weights)
    refiner = Refiner(chain.body, covariance=np.eye(85))
    errors = []
    for missing in KEYPOINTS.values():
        samples = chain.samples("val", missing, 1)
        guess = refiner.guess(samples.rotmats, samples.betas, samples.joints)
        errors.append(samples.true_state.change_from(guess))
    change = torch.cat(errors).double()
    covariance = (change.T @ change / len(change)).float().numpy()
    record = {
        "made_by": "python -m tests.benchmarks.refinement --covariance",
        "weights": weights,
        "samples": len(change),
        "data": "embedded validation clips, experiment=detector/cascade preset=small, half of them without keypoints",
    }
    np.savez(PATH, covariance=covariance, body=np.array(chain.body.hash), record=np.array(json.dumps(record)))
    turns = torch.from_numpy(covariance).diagonal()[:72].view(24, 3).sum(-1).sqrt().rad2deg()
    print(f"{PATH}: {len(change)} samples; a joint's rotation is off by {turns.mean():.0f} degrees")


def main() -> None:
    """Run what the arguments ask for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--weights", default=DEFAULT)
    parser.add_argument("--covariance", action="store_true")
    parser.add_argument("--times", action="store_true", help="what a frame costs, alone")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.covariance:
        make_covariance(arguments.weights)
    elif arguments.times:
        times(arguments.weights)
    else:
        tables(arguments.weights, arguments.samples)


if __name__ == "__main__":
    main()
