"""Deformation."""
import jax
import jax.numpy as jnp
from l2dgs_jax import hexplane, networks, spherical_harmonics
from l2dgs_jax.types import MovedGaussians


def deform(params, alive, bounds, cameras, cfg, *, moving, sh_degree_active):
    g = params.gaussians
    views = cameras.time.shape[0]
    spread = lambda x: jnp.broadcast_to(x[None], (views, *x.shape))
    centres = -jnp.einsum("vji,vj->vi", cameras.viewmat[:, :3, :3], cameras.viewmat[:, :3, 3])
    directions = spherical_harmonics.directions(spread(g.means), centres)
    basis = spherical_harmonics.basis(directions, cfg.sh_degree)
    degrees = jnp.array([d for d in range(cfg.sh_degree + 1) for _ in range(2 * d + 1)])
    b = jnp.concatenate([g.illumination_dc, g.illumination_rest], -1) * (degrees <= sh_degree_active)[None].astype(g.means.dtype)
    means, quats, log_scales, a = spread(g.means), spread(g.quats), spread(g.log_scales), 1.0
    if moving:
        space = hexplane.space_features(params.hexplane, g.means, bounds)

        def at(t):
            f = hexplane.features(params.hexplane, space, g.means, bounds, t, cfg)
            hidden, dm, dq, ds = networks.apply_heads(params.heads, f)
            return g.means + dm, g.quats + dq, g.log_scales + ds, networks.apply_ocd(params.ocd, hidden)

        means, quats, log_scales, a = jax.vmap(at)(cameras.time)
    illumination = jnp.maximum(cfg.illumination_offset + (a * spread(b) * basis).sum(-1), 0)
    opacity = jax.nn.sigmoid(g.logit_opacities) * alive.astype(g.means.dtype)
    return MovedGaussians(means, quats, jnp.exp(log_scales), spread(opacity), illumination, spread(g.reflectance), spread(g.attenuation))
