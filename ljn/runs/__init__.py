"""What a run leaves on disk, written and read in one place: record, metrics, checkpoints, locks, sweeps."""
