import numpy as np

from ljn.pipeline.depth import body_depth
from ljn.pipeline.pictures import draw_prediction


def test_a_picture_is_drawn_with_and_without_a_mesh(pipeline, given, kinect, tmp_path):
    found = pipeline(given[0], kinect, given[1])
    depth = body_depth(given[0], kinect)
    draw_prediction(found, depth, kinect).savefig(tmp_path / "mesh.png")
    alone = type(found)(found.joints, found.points)  # neither keypoints nor a mesh
    draw_prediction(alone, depth, kinect).savefig(tmp_path / "joints.png")
    assert (tmp_path / "mesh.png").stat().st_size > (tmp_path / "joints.png").stat().st_size > 20_000


def test_a_mesh_that_is_not_before_the_camera_is_said_to_be_so(pipeline, given, kinect):
    found = pipeline(given[0], kinect, given[1])
    found.vertices[:] -= np.float32([0, 0, 5])
    figure = draw_prediction(found, body_depth(given[0], kinect), kinect)
    assert "not before the camera" in figure.axes[3].get_title(loc="left")
