"""How fast samples are made and a detector trains: `make bench`.

One table from one run; ratios of speed are against the first row of each block. Whole samples come from two worker
processes, everything else from one thread. Rows are timed in turn over several rounds, and times and ratios are medians
over the rounds: a machine that changes its speed changes it for all rows of a round.
"""

import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from datamodules.batches import BLOCK, RepeatedBatches
from datamodules.noise import add_depth_noise
from datamodules.rendered import SynthesizedSamples
from datamodules.sources.embedded import EmbeddedSource
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import SMPL, SMPLOutput, SparseSMPL, load_body_models
from ljn.cloud.normals import get_normal_estimator
from ljn.cloud.observation import ObservationRecipe
from ljn.cloud.sampling import sample_cloud
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.nets.joint_network import LocalJointNetwork
from ljn.nets.layers import StackedLinear, StackedPReLU
from ljn.render import get_renderer

CAMERA = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
BATCH, NUM_POINTS = 16, 4096
ROUNDS, BATCHES = 7, 8
"""Of whole samples, `BATCHES` are timed in each round."""


def time_rows(
    title: str, rows: dict[str, Callable[[], object]], per_call: int = BATCH, rounds: int = 15
) -> None:
    """Time each row's call, which handles `per_call` samples, and print a block of the table."""
    for call in rows.values():
        call()
    found: dict[str, list[float]] = {name: [] for name in rows}
    for _ in range(rounds):
        for name, call in rows.items():
            start = time.perf_counter()
            call()
            found[name].append(1000 * (time.perf_counter() - start) / per_call)
    print_rows(title, found)


def print_rows(title: str, rounds: dict[str, list[float]]) -> None:
    """A block of the table: each row's milliseconds, and how many times faster than it the first row is."""
    print(f"\n{title:48s}{'ms/sample':>10s}{'samples/s':>11s}{'first is':>10s}", flush=True)
    first = next(iter(rounds.values()))
    for name, values in rounds.items():
        ms = statistics.median(values)
        ratio = statistics.median(value / of_first for value, of_first in zip(values, first))
        print(f"  {name:46s}{ms:10.2f}{1000 / ms:11.0f}{ratio:9.2f}x", flush=True)


class OfPosedBodies(DepthSynthesizer):
    """A synthesizer whose bodies were posed before the clock runs: the same few for every batch."""

    @cached_property
    def _smpl(self) -> Any:
        return PosedBodies(SMPL(self.bodies), self.records)


class PosedBodies:
    """Answers like the SMPL layer, with the first bodies of a table of records."""

    def __init__(self, layer: SMPL, records: Any) -> None:
        columns = (records.pose[:BATCH], records.betas[:BATCH], records.gender[:BATCH])
        self.faces = layer.faces
        self.posed = layer(*map(torch.from_numpy, columns))

    def __call__(self, pose: Tensor, betas: Tensor, gender: Tensor) -> SMPLOutput:
        return self.posed


def time_loaders(title: str, synthesizers: dict[str, DepthSynthesizer]) -> None:
    """Time whole samples as they come from two workers and print a block of the table.

    All rows' workers live through all rounds; those of a row that is not being timed have batches ready and wait.
    """
    ready = 2 * 2  # workers, each with one batch made and one begun
    keys = [[(0, index) for index in range(BATCH)]] * (ROUNDS + 1) * (ready + BATCHES)
    arriving: dict[str, Iterator[object]] = {}
    for name, synthesizer in synthesizers.items():
        loader = DataLoader(
            SynthesizedSamples(synthesizer),
            batch_sampler=keys,
            collate_fn=_as_is,
            num_workers=2,
            prefetch_factor=1,
            multiprocessing_context="spawn" if synthesizer.settings.renderer == "pyrender" else "fork",
        )
        arriving[name] = iter(loader)
    for batches in arriving.values():
        for _ in range(ready):
            next(batches)
    found: dict[str, list[float]] = {name: [] for name in synthesizers}
    for _ in range(ROUNDS):
        for name, batches in arriving.items():
            for _ in range(ready):
                next(batches)
            start = time.perf_counter()
            for _ in range(BATCHES):
                next(batches)
            seconds = time.perf_counter() - start
            found[name].append(1000 * seconds / (BATCHES * BATCH))
            time.sleep(1.5 * ready * seconds / BATCHES)  # until its workers wait, too
    print_rows(title, found)


def time_reuse(title: str, rows: dict[str, tuple[int, DepthSynthesizer]]) -> None:
    """Time whole samples in one thread, as many of each render as the row says, and print a block of the table."""
    number, epochs = 4 * BLOCK, itertools.count()

    def make(reuse: int, synthesizer: DepthSynthesizer) -> None:
        some = itertools.islice(epochs, number)  # of which nothing is kept yet
        plain = [[(epoch, index) for index in range(BATCH)] for epoch in some]
        for keys in RepeatedBatches(plain, reuse):  # type: ignore[arg-type]
            synthesizer.batch(keys)

    calls = {name: lambda row=row: make(*row) for name, row in rows.items()}  # type: ignore[misc]
    time_rows(title, calls, per_call=number * BATCH, rounds=3)  # type: ignore[arg-type]


def _as_is(batch: Any) -> Any:
    return batch


def as_loop(net: LocalJointNetwork) -> LocalJointNetwork:
    """The same network, its stacked layers run as a loop over the joints: the reference."""

    def linear(layer: StackedLinear) -> Callable[[Tensor], Tensor]:
        return lambda x: torch.stack(
            [torch.nn.functional.linear(*slices) for slices in zip(x, layer.weight, layer.bias)]
        )

    def prelu(layer: StackedPReLU) -> Callable[[Tensor], Tensor]:
        return lambda x: torch.stack(
            [torch.nn.functional.prelu(part, slope[None]) for part, slope in zip(x, layer.weight)]
        )

    for layer in net.modules():
        if isinstance(layer, StackedLinear):
            layer.forward = linear(layer)  # type: ignore[method-assign]
        elif isinstance(layer, StackedPReLU):
            layer.forward = prelu(layer)  # type: ignore[method-assign]
    return net


def available(names: tuple[str, ...], make: Callable[[str], object]) -> list[str]:
    """Those of the names whose packages are installed."""
    kept = []
    for name in names:
        try:
            make(name)
            kept.append(name)
        except ImportError as error:
            print(f"without {name}: {error}")
    return kept


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    renderers = available(("zbuffer", "torch", "pyrender", "open3d"), get_renderer)
    estimators = available(("window", "knn", "open3d"), get_normal_estimator)

    source = EmbeddedSource()
    bodies = load_body_models(None, source.genders)
    records = source.records("train", 256, seed=0)
    columns = [torch.from_numpy(c[:BATCH]) for c in (records.pose, records.betas, records.gender)]

    # First, while this process has neither a GL context nor Open3D's threads: the workers are forked from it.
    pairs = (("zbuffer", "window"), ("zbuffer", "knn"), ("zbuffer", "open3d"), ("pyrender", "open3d"))
    pairs = [pair for pair in pairs if pair[0] in renderers and pair[1] in estimators]
    for title, kind in (("with the body", DepthSynthesizer), ("without the body", OfPosedBodies)):
        time_loaders(
            f"whole samples {title}, {NUM_POINTS} points, 2 workers",
            {
                f"{renderer} + {normals} normals": kind(
                    *(records, bodies, CAMERA, SynthesisSettings(renderer=renderer)),
                    *(ObservationRecipe(NUM_POINTS, normals), ("points",), (0, 0)),
                )
                for renderer, normals in pairs
            },
        )

    recipe, noised = ObservationRecipe(1024), SynthesisSettings(initial_joints="noised")
    for title, settings, takes in (
        ("1024 points", SynthesisSettings(), ("points",)),
        ("crops", SynthesisSettings(), ("crop", "crop_camera")),
        ("joints with noise alone", noised, ()),
    ):
        given = (records, bodies, CAMERA, settings, recipe, takes, (0, 0), torch.float32)
        time_reuse(
            f"{title}, one thread, data.reuse",
            {
                f"{reuse} of each render": (reuse, DepthSynthesizer(*given, BLOCK if reuse > 1 else 0))
                for reuse in (1, 2, 4)
            },
        )

    smpl = SMPL(bodies)
    with torch.no_grad():
        vertices = smpl(*columns).vertices @ CAMERA_FROM_BODY.float().T
    vertices = vertices - vertices.mean(1, keepdim=True) + torch.tensor([0.0, 0, 2.2])
    render = {name: get_renderer(name) for name in renderers}
    time_rows(
        "depth of posed bodies, 424 x 512",
        {name: lambda r=r: r(vertices, smpl.faces, CAMERA) for name, r in render.items()},  # type: ignore[misc]
    )

    depth = [
        add_depth_noise(image, 0.001, np.random.default_rng(0))
        for image in render["zbuffer"](vertices, smpl.faces, CAMERA).numpy()
    ]
    clouds = [sample_cloud(image, CAMERA, NUM_POINTS, np.random.default_rng(0)) for image in depth]
    estimate = {name: get_normal_estimator(name) for name in estimators}
    time_rows(
        f"normals of {NUM_POINTS} points",
        {
            name: lambda e=e: [e(cloud, image, CAMERA) for cloud, image in zip(clouds, depth)]  # type: ignore[misc]
            for name, e in estimate.items()
        },
    )
    with torch.no_grad():
        layers = {"from nonzero offsets": SparseSMPL(bodies), "SMPL layer": smpl}
        time_rows(
            f"the body alone, two genders, batch {BATCH}",
            {name: lambda layer=layer: layer(*columns) for name, layer in layers.items()},  # type: ignore[misc]
        )

    points, joints = torch.randn(BATCH, 1024, 6) * 0.3, torch.randn(BATCH, 24, 3) * 0.3
    sizes = {
        "group_size": 64,
        "local_channels": (32, 32),
        "global_channels": (32, 64, 128),
        "group_channels": (32, 64, 128),
        "head_channels": (128, 64),
    }
    networks = {
        "stacked over the joints": LocalJointNetwork([0.25] * 24, **sizes),  # type: ignore[arg-type]
        "a loop over the joints": as_loop(LocalJointNetwork([0.25] * 24, **sizes)),  # type: ignore[arg-type]
    }

    def step(net: LocalJointNetwork) -> None:
        net.zero_grad()
        net(points, joints).square().sum().backward()

    time_rows(
        "a training step of LJN_jd, preset=small",
        {name: lambda n=net: step(n) for name, net in networks.items()},  # type: ignore[misc]
    )


if __name__ == "__main__":
    main()
