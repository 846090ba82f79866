"""The named presets; docs/record.md has the reasons for each setting of `default`, and the measurements.

`paper` follows the text of the paper, `authors` the authors' released code. `default` has measured best; `fast` and
`demo` are shorter, `best` is longer. `4dgs`, `enhance-4dgs`, `curve-4dgs` and `static` are baselines to compare
`default` with, after those of the paper's Table 1, and take as many steps as it does.
"""

import dataclasses

from l2dgs_jax.config.settings import Config, DensityConfig, LossConfig, ModelConfig, OptimConfig


def _presets() -> dict[str, Config]:
    paper = Config(
        normalise=False,
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
        coarse_steps=100,  # moving things are blurred in the coarse stage: only as long as geometry needs it
        fine_steps=1100,
        inbetweens=0.3,
        model=ModelConfig(
            unit="depth",
            scale_growth="bounded",  # otherwise a few static Gaussians grow to veils before the scene
            motion_gate=True,
            shut_gates=0.3,  # otherwise static parts keep moving a little, and the longer they train the more
            tracks=True,
            surfaces=True,  # in the dark, structure from motion finds few points
            hidden=64,
            plane_scales=(1, 2),
            opacity_head=True,  # lets a Gaussian fade at instants at which it does not belong where it is
            identity_start=True,  # the fine stage starts from the coarse stage's result instead of from a jump
            reflectance_init="observed",
            bounded_reflectance=True,  # otherwise what few frames see takes on colours that no frame shows
            initial_exponents=("auto", 9.0),
            initial_illumination="auto",
            initial_opacity=0.3,
            tone="auto",
            domain="auto",  # on sRGB values, B1 would have to imitate the sRGB curve
            relative_light=True,
            exposure="auto",
            bafe=False,  # in linear light, a single gain explains a dark frame
        ),
        loss=LossConfig(
            eta_end=0.75,  # if dark frames are brightened more, SSIM compares mostly noise
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
            extent_scales=("means", "paths"),  # the parameters of the motion field are not lengths
            illumination_lr=1e-3,
            reflectance_lr=5e-3,  # 1e-5 moves a reflectance by 0.03 in 3,000 steps
            attenuation_lr=5e-3,
            heads_lr=1.5e-3,
            planes_lr=1.6e-2,
            ocd_lr=5e-5,
            decay_steps=2400,  # motion would remain half learned if its rates decayed fully within the run
            cooldown=0.3,  # otherwise the views of the last steps count more than others
        ),
        # New Gaussians leave the image nearly unchanged. None is relocated (prune_opacity 0), because moving things are
        # faint before their motion is learned.
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
    # A smaller motion field, only the scene's own points, fewer steps and no densification, so that scales must be
    # learned faster.
    demo = dataclasses.replace(
        default,
        coarse_steps=150,
        fine_steps=250,
        sh_warmup=150,
        model=dataclasses.replace(default.model, plane_size=32, hidden=32, surfaces=False),
        optim=dataclasses.replace(default.optim, scales_lr=0.04, quats_lr=4e-3, decay_steps=None),
        density=dataclasses.replace(default.density, stop=0),
    )
    # 4DGS (arXiv 2310.08528): its model, objective, learning rates and decay; steps and densification of `default`.
    four_d = Config(
        normalise=False,
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
            reflectance_lr=7e-4,  # 4DGS: 2.5e-3 for the SH coefficient, which the constant harmonic multiplies by 0.28
            decay_steps=None,
        ),
        density=default.density,
    )
    # The colours, tone curves and priors of Luminance-GS (arXiv 2504.01503), as far as model/tone_curves.py has them.
    curve = dataclasses.replace(
        four_d,
        model=dataclasses.replace(four_d.model, decomposition="curve", background=0.0),
        # ssim 0.25, with eta 1, is its 0.2 of SSIM to 0.8 of L1 but for eps; the priors have the ratio that they had in
        # its code until July 2025.
        loss=dataclasses.replace(four_d.loss, ssim=0.25, eta_start=1.0, eta_end=1.0, equalisation=0.01, bend=0.05),
    )
    # Only the coarse stage, in which the motion field does not act; without tracks, because their paths would move.
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
