import pytest
from scenes import write_nerfies


@pytest.fixture
def scene(tmp_path):
    return write_nerfies(tmp_path / "scene")
