"""Pure functions on rotations, cameras and points. The project's conventions stand here, once.

Units: metres and radians everywhere inside; millimetres only in reported metrics, pixels where a name
ends in `_px`.

Frames:
    - body world: z up, x forward, y to the body's left; a pose's first rotation (heading included) maps
      the SMPL rest frame (y up, z forward, x to the body's left) into it;
    - camera: OpenCV's, x right, y down, z forward. Pixel centres are at integer coordinates.

Vectors are columns: `R @ v`. Letters in shapes: B batch, N points, K joints, V vertices, F faces, H, W
image; `...` any leading dimensions.
"""
