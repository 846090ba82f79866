import finished_run
import numpy as np
import pytest

from l2dgs_jax.visualize import view


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.getbasetemp()


def test_welllit_is_the_whole_outputs_and_grows_its_buffer(base):
    run = finished_run.opened(base)
    camera = view(run.dataset.test.cameras, 0)
    whole, short = run.renderer(), run.renderer()
    short.pair_capacity = 8
    np.testing.assert_allclose(short.welllit(camera), whole(camera).images.welllit, atol=1e-6)
    assert short.pair_capacity > 8
