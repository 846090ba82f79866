"""The named presets; docs/record.md says why each setting of `default` is what it is, and what it measures.

`paper` is the text of the paper to the letter, `authors` what the authors' released code does, `default` what measures
best, `fast` and `demo` a short `default`, `best` a long one. `4dgs`, `enhance-4dgs`, `curve-4dgs` and `static` are what
to compare it with: baselines after those of the paper's Table 1, in as many steps.
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
        coarse_steps=100,  # what moves is smeared in the coarse stage: no longer than geometry needs
        fine_steps=1100,
        inbetweens=0.3,
        model=ModelConfig(
            unit="depth",
            scale_growth="linear",  # exponentially, a few Gaussians come to fill the picture
            motion_gate=True,
            tracks=True,
            surfaces=True,  # in the dark, structure from motion finds few points
            hidden=64,
            plane_scales=(1, 2),
            opacity_head=True,  # a copy of what moves can fade where it does not belong
            identity_start=True,  # the fine stage starts from the coarse stage's result instead of from a jump
            reflectance_init="observed",
            bounded_reflectance=True,  # or what few frames see takes colours that no frame shows
            initial_exponents=("auto", 9.0),
            initial_illumination="auto",
            initial_opacity=0.3,
            tone="auto",
            domain="auto",  # with values, B1 would have to do what the sRGB curve does
            relative_light=True,
            exposure="auto",
            bafe=False,  # of light, one gain explains a dark frame
        ),
        loss=LossConfig(
            eta_end=0.75,  # brightened more than that, dark frames are mostly noise to SSIM
            exposure=1.0,
            exposure_level="auto",
            exposure_of="welllit",
            exposure_window=None,
            exposure_form="squared",
            amplification=0.0,
            structure=0.1,
            illumination_tv=1.0,
            exponent_prior=0.2,
            gate=0.03,
        ),
        optim=OptimConfig(
            extent_scales=("means", "paths"),  # motion field and heads have no unit
            illumination_lr=1e-3,
            reflectance_lr=5e-3,  # 1e-5 moves a reflectance by 0.03 in 3,000 steps
            attenuation_lr=5e-3,
            heads_lr=1.5e-3,
            planes_lr=1.6e-2,
            ocd_lr=5e-5,
            decay_steps=2400,  # motion would end half learned if its rates fell to their end within the run
        ),
        # Births leave the image nearly as it is. Nothing is carried off: before its motion is learned, what moves is
        # faint.
        density=DensityConfig(
            method="mcmc",
            start=100,
            stop=800,
            interval=50,
            prune_opacity=0.0,
            max_gaussians="auto",
            drawn_by="gradient",
            spread=0.5,
        ),
    )
    fast = dataclasses.replace(default, fine_steps=500, density=dataclasses.replace(default.density, stop=400))
    best = dataclasses.replace(
        default,
        fine_steps=4900,
        model=dataclasses.replace(default.model, hidden=128, plane_scales=(1, 2, 4)),
        optim=dataclasses.replace(default.optim, decay_steps=7500),
        density=dataclasses.replace(default.density, stop=3000),
    )
    # A smaller motion field, the scene's own points and fewer steps, in which nothing is added; so sizes must learn
    # faster.
    demo = dataclasses.replace(
        default,
        coarse_steps=150,
        fine_steps=250,
        sh_warmup=150,
        model=dataclasses.replace(default.model, plane_size=32, hidden=32, surfaces=False),
        optim=dataclasses.replace(default.optim, scales_lr=0.04, quats_lr=4e-3, decay_steps=None),
        density=dataclasses.replace(default.density, stop=0),
    )
    # 4DGS (arXiv 2310.08528): its model, objective, rates and schedule; steps and growth of `default`.
    four_d = Config(
        coarse_steps=default.coarse_steps,
        fine_steps=default.fine_steps,
        model=ModelConfig(
            decomposition="none",
            ocd=False,
            time_size=150,
            time_range="upper",
            aggregation="product",
            reflectance_init="observed",
            background=1.0,
        ),
        loss=LossConfig(ssim=0.0, exposure=0.0, amplification=0.0, structure=0.0, depth=0.0),
        optim=OptimConfig(
            reflectance_lr=7e-4,  # 2.5e-3 for a coefficient of the constant harmonic, 0.28
            decay_steps=None,
        ),
        density=default.density,
    )
    # The colours, tone curves and priors of Luminance-GS (arXiv 2504.01503), as far as they are model/tone_curves.py.
    curve = dataclasses.replace(
        four_d,
        model=dataclasses.replace(four_d.model, decomposition="curve", background=0.0),
        # A quarter, on the images themselves, is its 0.2 of SSIM to 0.8 of the difference; 1 to 5 are its later priors.
        loss=dataclasses.replace(four_d.loss, ssim=0.25, eta_start=1.0, eta_end=1.0, equalisation=0.01, bend=0.05),
    )
    # The first stage, in which nothing moves, for as long as `default`; paths would move.
    static = dataclasses.replace(
        default,
        coarse_steps=default.steps,
        fine_steps=0,
        model=dataclasses.replace(default.model, tracks=False),
    )
    return {
        "paper": paper,
        "authors": authors,
        "default": default,
        "fast": fast,
        "best": best,
        "demo": demo,
        "4dgs": four_d,
        "enhance-4dgs": dataclasses.replace(four_d, enhance="zero-dce"),
        "curve-4dgs": curve,
        "static": static,
    }


PRESETS = _presets()
