import pytest
from synthetic_pickup import pickup, report


@pytest.fixture(scope="session")
def scene():
    """A pickup past three distractors."""
    return pickup("3 distractors", 3, steps=60, horizon=5)


@pytest.fixture(scope="session")
def data(scene):
    return report((scene, pickup("no distractors", 0, steps=60, horizon=5)))
