"""Networks like LPIPS's with random weights, in full size or tiny."""

import numpy as np

from l2dgs_jax.metrics import NETWORKS
from l2dgs_jax.metrics.lpips import Layer

TINY = (Layer(0, 5, 3, 4, stride=2, padding=2), Layer(3, 3, 4, 6, pool=2, compared=False), Layer(6, 3, 6, 5))


def state_dict(network, seed=0):
    """Arrays as `lpips.LPIPS(net).state_dict()` has them."""
    rng = np.random.default_rng(seed)
    arrays = {"scaling_layer.shift": np.zeros((1, 3, 1, 1), np.float32)}
    heads = 0
    for place, layer in enumerate(NETWORKS[network]):
        shape = (layer.outputs, layer.inputs, layer.size, layer.size)
        name = f"net.slice{1 + place // 3}.{layer.place}"
        arrays[f"{name}.weight"] = rng.normal(0, np.prod(shape[1:]) ** -0.5, shape).astype(np.float32)
        arrays[f"{name}.bias"] = rng.normal(0, 0.1, layer.outputs).astype(np.float32)
        if layer.compared:
            arrays[f"lin{heads}.model.1.weight"] = rng.uniform(size=(1, layer.outputs, 1, 1)).astype(np.float32)
            heads += 1
    return arrays
