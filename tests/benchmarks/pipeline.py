"""How fast samples are made and a detector trains: `make bench`.

One table from one run; ratios are against the first row of each block. One thread, medians.
"""

import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from datamodules.sources.embedded import EmbeddedSource
from datamodules.synthesis import DepthSynthesizer, SynthesisSettings
from ljn.body import SMPL, load_body_model
from ljn.cloud.normals import get_normal_estimator
from ljn.cloud.sampling import add_depth_noise, sample_cloud
from ljn.geometry.camera import Camera
from ljn.geometry.rotations import CAMERA_FROM_BODY
from ljn.nets.joint_network import LocalJointNetwork
from ljn.nets.layers import StackedLinear, StackedPReLU
from ljn.optional import import_open3d
from ljn.render import get_renderer

CAMERA = Camera(fx=366.458, fy=366.736, cx=206.470, cy=253.026, width=424, height=512)
BATCH, NUM_POINTS, REPEATS = 16, 4096, 15


def median_ms(call: Callable[[], object], per: int = BATCH) -> float:
    """Median milliseconds of a call, divided by the samples that it handles; after one that does not count."""
    call()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times) / per


def print_block(title: str, rows: dict[str, Callable[[], object]]) -> None:
    """Time each row and print it beside its ratio to the first."""
    print(f"\n{title:44s}{'ms/sample':>10s}{'samples/s':>11s}{'ratio':>8s}")
    first = None
    for name, call in rows.items():
        value = median_ms(call)
        first = first or value
        print(f"  {name:42s}{value:10.2f}{1000 / value:11.0f}{value / first:8.2f}")


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


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    try:
        import_open3d()
        has_open3d = True
    except ImportError as error:
        has_open3d = False
        print(f"without Open3D's rows: {error}")

    body = load_body_model()
    records = EmbeddedSource().records("train", 256, seed=0)
    keys = [(0, index) for index in range(BATCH)]
    settings = SynthesisSettings(camera=CAMERA, num_points=NUM_POINTS)

    smpl = SMPL(body)
    pose, betas = torch.from_numpy(records.pose[:BATCH]), torch.from_numpy(records.betas[:BATCH])
    with torch.no_grad():
        vertices = smpl(pose, betas).vertices @ CAMERA_FROM_BODY.float().T
    vertices = vertices - vertices.mean(1, keepdim=True) + torch.tensor([0.0, 0, 2.2])
    backends = ["zbuffer", *(["open3d"] if has_open3d else [])]
    renderers = {name: get_renderer(name) for name in backends}
    print_block(
        "depth of a posed body, 424 x 512",
        {name: lambda r=renderer: r(vertices, smpl.faces, CAMERA) for name, renderer in renderers.items()},
    )

    depth = [
        add_depth_noise(d, 0.001, np.random.default_rng(0))
        for d in renderers["zbuffer"](vertices, smpl.faces, CAMERA).numpy()
    ]
    clouds = [sample_cloud(d, CAMERA, NUM_POINTS, np.random.default_rng(0)) for d in depth]
    kinds = ["window", *(["open3d"] if has_open3d else [])]
    estimators = {name: get_normal_estimator(name) for name in kinds}
    print_block(
        f"normals of {NUM_POINTS} points",
        {
            name: lambda e=estimate: [e(cloud, d, CAMERA) for cloud, d in zip(clouds, depth)]
            for name, estimate in estimators.items()
        },
    )

    def synthesizer(**changes: object) -> DepthSynthesizer:
        return DepthSynthesizer(records, body, SynthesisSettings(**{**vars(settings), **changes}), (0, 0))

    combinations = {"zbuffer + window": synthesizer()}
    if has_open3d:
        combinations["zbuffer + open3d normals"] = synthesizer(normals="open3d")
        combinations["open3d + open3d normals"] = synthesizer(renderer="open3d", normals="open3d")
    with torch.no_grad():
        rows: dict[str, Callable[[], object]] = {
            name: lambda s=s: s.batch(keys) for name, s in combinations.items()
        }
        print_block(f"a whole sample, body included, {NUM_POINTS} points", rows)
        print_block("the body alone", {"SMPL layer, batch 16": lambda: smpl(pose, betas)})

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

    print_block(
        "a training step of LJN_jd, preset=small",
        {name: lambda n=net: step(n) for name, net in networks.items()},
    )


if __name__ == "__main__":
    main()
