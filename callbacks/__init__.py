"""Lightning and Hydra callbacks: drawing, progress, files beside a run."""
