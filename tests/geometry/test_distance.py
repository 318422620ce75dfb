import numpy as np
import pytest

from ljn.geometry.distance import distances_to_mesh


def test_distances_to_a_square_are_those_of_its_closed_form():
    # The unit square in the plane z = 0, as two triangles.
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    points = np.random.default_rng(0).uniform(-1, 2, (500, 3))
    outside = points - points.clip([0, 0, 0], [1, 1, 0])
    np.testing.assert_allclose(distances_to_mesh(points, vertices, faces), np.linalg.norm(outside, axis=-1))


def test_points_on_a_body_have_no_distance_and_those_along_its_normals_have_theirs(body):
    corners = body.v_template[body.faces[::50]].astype(np.float64)
    middle = corners.mean(1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    assert distances_to_mesh(middle, body.v_template, body.faces).max() < 1e-7
    off = distances_to_mesh(middle + 0.001 * normal, body.v_template, body.faces)
    assert off.max() < 0.001 + 1e-7
    assert np.median(off) == pytest.approx(0.001, abs=1e-6)


def test_a_face_without_area_counts_as_the_line_that_it_is():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0, 0, 0]])
    distance = distances_to_mesh(np.array([[0.3, 0.4, 0]]), vertices, np.array([[0, 1, 2], [0, 3, 0]]))
    assert distance == pytest.approx(0.4)
