"""The named presets; docs/presets.md says why each setting of `default` is what it is, and what it measures.

`paper` is the text of the paper to the letter, `authors` what the authors' released code does, `default` what measures
best, `demo` a short `default`.
"""

import dataclasses

from l2dgs_jax.config.settings import Config, DensityConfig, LossConfig, ModelConfig, OptimConfig


def _presets() -> dict[str, Config]:
    paper = Config(
        model=ModelConfig(
            illumination_offset=0.0,
            reflectance_init="normal",
            attenuation_init="normal",
        ),
        density=DensityConfig(prune_above=200_000),
    )
    authors = dataclasses.replace(
        paper,
        fine_steps=14_000,
        model=ModelConfig(
            time_size=150,
            time_range="upper",
            aggregation="product",
            reflectance_init="normal",
            attenuation_init="normal",
            background=1.0,
        ),
        loss=LossConfig(
            l1_on="tonemapped",
            eps=1e-5,
            eta_restarts=True,
            exposure=1.0,
            exposure_form="squared",
            structure_gradient="magnitude",
            depth_gradient="sobel",
            depth_gain=5.0,
        ),
        optim=OptimConfig(extent_scales=("means", "heads", "planes", "ocd", "bafe")),
    )
    default = Config(
        coarse_steps=600,
        fine_steps=600,
        model=ModelConfig(
            hidden=64,
            plane_scales=(1, 2),
            opacity_head=True,  # a copy of what moves can fade where it does not belong
            identity_start=True,  # the fine stage starts from the coarse stage's result instead of from a jump
            reflectance_init="observed",
            initial_exponents=("auto", 9.0),
            initial_illumination="auto",
        ),
        loss=LossConfig(
            exposure=1.0,
            exposure_level=0.46,  # photographers' middle grey, 18 % linear, in sRGB
            exposure_of="welllit",
            exposure_window=None,
            exposure_form="squared",
            amplification=0.0,
            structure=0.1,
            illumination_tv=1.0,
            exponent_prior=0.2,
        ),
        optim=OptimConfig(
            reflectance_lr=5e-3,  # 1e-5 moves a reflectance by 0.03 in 3,000 steps
            attenuation_lr=5e-3,
            heads_lr=1.5e-3,
            planes_lr=1.6e-2,
            ocd_lr=5e-5,
            decay_steps=2400,  # motion would end half learned if its rates fell to their end within 600 steps
        ),
        # No growth: each time is a shock that takes hundreds of steps to heal.
        density=DensityConfig(start=200, stop=0, interval=200, grad_threshold=5e-4, conserve_opacity=True),
    )
    # A smaller motion field and fewer steps.
    demo = dataclasses.replace(
        default,
        coarse_steps=150,
        fine_steps=250,
        sh_warmup=150,
        model=dataclasses.replace(default.model, plane_size=32, hidden=32),
        optim=dataclasses.replace(default.optim, decay_steps=None),
    )
    return {"paper": paper, "authors": authors, "default": default, "demo": demo}


PRESETS = _presets()
