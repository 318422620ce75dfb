r"""Depth frames that ship, with their truth: what `task=demo` predicts. A folder for each camera.

They are samples of the test set, made by

    python run.py task=export task.directory=ljn/demo/kinect_v2 data.num_test=96 \
        task.indices=[47,16,73] task.names=[walking,sitting,dancing]
    python run.py task=export task.directory=ljn/demo/realsense_d435 data.num_test=96 data.eval_seed=1 \
        task.indices=[70,78,89] task.names=[running,pointing,stretching] data.camera.fx=385 data.camera.fy=385 \
        data.camera.cx=319.5 data.camera.cy=239.5 data.camera.width=640 data.camera.height=480
"""

from pathlib import Path

FRAMES = Path(__file__).parent
"""The folder; `ljn.pipeline.samples.find_samples` reads it."""
