"""What `run.py` can do: each task takes the composed configuration and gives back a flat dict of metrics.

Only this package, `ljn/building.py` and `run.py` see a `DictConfig`.
"""
