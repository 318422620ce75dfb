"""A benchmark of predictors of joints and meshes: on fixed samples under many conditions, or on real frames."""
