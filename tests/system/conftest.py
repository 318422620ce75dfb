import pytest

from ljn.pipeline.pipeline import Pipeline


@pytest.fixture(scope="session")
def shipped():
    """The pipeline of the weights that ship."""
    return Pipeline.from_pretrained()
