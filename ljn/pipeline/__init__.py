"""From a depth image and 2D keypoints to joints and a mesh, as a user has them: inputs, pipeline, outputs."""
