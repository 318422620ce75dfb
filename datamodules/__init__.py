"""LightningDataModules: where samples come from."""
