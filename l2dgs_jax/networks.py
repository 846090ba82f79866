"""Networks."""
import jax
import jax.numpy as jnp
from l2dgs_jax.types import BAFENet, Conv, GroupNorm, Linear, MotionHeads, OCDNet


def _xavier(key, shape, fan_in, fan_out):
    limit = (6 / (fan_in + fan_out)) ** 0.5
    return jax.random.uniform(key, shape, minval=-limit, maxval=limit)


def _linear(key, i, o):
    return Linear(_xavier(key, (i, o), i, o), jnp.zeros(o))


def _apply(layer, x):
    return x @ layer.weight + layer.bias[None]


def init_heads(key, feature_size, cfg):
    keys = iter(jax.random.split(key, 7))
    h = cfg.hidden

    def head(size):
        first, last = _linear(next(keys), h, h), _linear(next(keys), h, size)
        return first, jax.tree.map(jnp.zeros_like, last) if cfg.identity_start else last

    return MotionHeads(_linear(next(keys), feature_size, h), head(3), head(4), head(3))


def apply_heads(heads, f):
    hidden = _apply(heads.aggregate, f)
    active = jax.nn.relu(hidden)
    return hidden, *(_apply(last, jax.nn.relu(_apply(first, active))) for first, last in heads[1:])


def init_ocd(key, cfg):
    keys = jax.random.split(key)
    j = (cfg.sh_degree + 1) ** 2
    out = _linear(keys[1], cfg.hidden, j)
    if cfg.identity_start:
        out = Linear(jnp.zeros_like(out.weight), jnp.ones_like(out.bias))
    return OCDNet(_linear(keys[0], cfg.hidden, cfg.hidden), out)


def apply_ocd(ocd, hidden):
    return jax.nn.relu(_apply(ocd.out, jax.nn.elu(_apply(ocd.hidden, jax.nn.elu(hidden)))))


def init_bafe(key, cfg):
    keys = jax.random.split(key, 4)
    conv = lambda k, s, i, o: Conv(_xavier(k, (s, s, i, o), s * s * i, s * s * o), jnp.zeros(o))
    norm = lambda c: GroupNorm(jnp.ones(c), jnp.zeros(c))
    out = conv(keys[3], 1, 8, 2)
    if cfg.initial_exponents is not None:
        y = (jnp.array(cfg.initial_exponents) - 5.5) / 4.5
        out = Conv(jnp.zeros_like(out.weight), y / (1 - jnp.abs(y)))
    return BAFENet(conv(keys[0], 5, 2, 8), norm(8), conv(keys[1], 3, 8, 16), norm(16), conv(keys[2], 3, 16, 8), norm(8), out)


def _conv(layer, x):
    y = jax.lax.conv_general_dilated(x, layer.weight, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))
    return y + layer.bias[None, None, None]


def _norm(layer, x, groups):
    b, h, w, c = x.shape
    g = x.reshape(b, h, w, groups, c // groups)
    m = g.mean((1, 2, 4), keepdims=True)
    v = jnp.square(g - m).mean((1, 2, 4), keepdims=True)
    g = ((g - m) / jnp.sqrt(v + 1e-5)).reshape(b, h, w, c)
    return g * layer.scale[None, None, None] + layer.bias[None, None, None]


def apply_bafe(bafe, attenuation):
    lead = attenuation.shape[:-3]
    x = jnp.tanh(attenuation.reshape(-1, *attenuation.shape[-3:]))
    act = lambda v: jax.nn.leaky_relu(v, 0.01)
    x1 = act(_norm(bafe.norm1, _conv(bafe.conv1, x), 2))
    x2 = act(_norm(bafe.norm2, _conv(bafe.conv2, x1), 4))
    x3 = act(_norm(bafe.norm3, _conv(bafe.conv3, x2), 2) + 0.3 * x1)
    out = 4.5 * jax.nn.soft_sign(_conv(bafe.out, x3)) + 5.5
    return out.reshape(*lead, *out.shape[-3:])
