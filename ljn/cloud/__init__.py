"""From a depth image to what the networks take: a sampled point cloud, its normals, lifted keypoints."""
