"""LightningModules: networks with their losses, optimizers and metrics."""
