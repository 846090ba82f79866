"""Every setting, as frozen dataclasses, and the named presets.

A setting's comment says what it is; a preset's comment says why it differs. `paper` is the text of the paper to the
letter, `authors` what their released code does, `default` what measures best (README, "Results").
"""

import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Literal

LayoutName = Literal["nerfies", "colmap", "transforms", "llff"]
Layout = Literal["auto"] | LayoutName


@dataclass(frozen=True)
class ModelConfig:
    """Shape and initial state of a scene."""

    sh_degree: int = 3  # bands k of Eq. 2; (k+1)^2 coefficients
    plane_size: int = 64  # cells of a spatial axis at the coarsest scale
    plane_scales: tuple[int, ...] = (1, 2, 4)  # factors on plane_size, concatenated; time is never scaled
    plane_channels: int = 16
    time_size: int | None = None  # cells of the time axis; None: half the number of training frames
    time_range: Literal["full", "upper"] = "full"  # "upper": t in [0, 1] read as [-1, 1], half of each time plane
    aggregation: Literal["paired_sum", "product"] = "paired_sum"  # Eq. 1, or the product of all six planes
    hidden: int = 128  # width of g, of the heads and of OCD-Net
    opacity_head: bool = False  # a fourth head moves the opacity's logit, as 4DGS can (arXiv 2310.08528)
    identity_start: bool = False  # heads and OCD-Net start as "no motion, a_j = 1" instead of at random
    illumination_offset: float = 0.5  # l = max(offset + sum a_j b_j B_j, 0)
    # N(0, 1), U(0, 1), or the frames' colours at the points, with the darkening of tone.py undone
    reflectance_init: Literal["normal", "uniform", "observed"] = "uniform"
    attenuation_init: Literal["normal", "uniform"] = "uniform"
    # B1, B2 that BAFE-Net starts at; None: zero bias, 5.5. B1 "auto": what the frames' darkness implies (tone.py)
    initial_exponents: tuple[float | Literal["auto"], float] | None = None
    # l of every Gaussian at the start; None: luminance of the points. "auto": what makes L^B2 the darkening's gain
    initial_illumination: float | Literal["auto"] | None = None
    initial_opacity: float = 0.1
    background: float = 0.0  # value of L and R where nothing is drawn


@dataclass(frozen=True)
class LossConfig:
    """Weights and forms of Eqs. 10-15 and of the plane regularisers."""

    l1_on: Literal["raw", "tonemapped"] = "raw"  # first term of Eq. 10 on I, or on (I + eps)^eta like the second
    ssim: float = 1.0
    eps: float = math.exp(-5)
    eta_start: float = 0.95
    eta_end: float = 0.5
    eta_restarts: bool = False  # the decay starts anew with the fine stage
    exposure: float = 0.01  # lambda_1, Eq. 11
    exposure_level: float = 0.6
    exposure_of: Literal["reflectance", "welllit"] = "reflectance"
    exposure_window: int | None = 16  # pixels; None: the mean of the whole image
    exposure_form: Literal["absolute", "squared"] = "absolute"
    amplification: float = 0.05  # lambda_2, Eq. 13
    structure: float = 1.0  # lambda_3 = lambda_4, Eq. 14
    structure_beta: float = 0.5
    structure_gradient: Literal["components", "magnitude"] = "components"  # forward differences, or sqrt(dx^2 + dy^2)
    depth: float = 0.001  # lambda_5, Eq. 12
    depth_gradient: Literal["forward", "sobel"] = "forward"
    depth_gain: float = 1.0  # factor on D inside Eq. 12
    illumination_tv: float = 0.0  # mean |forward difference| of L_w
    exponent_prior: float = 0.0  # mean |B1 - initial B1|
    plane_smoothness: float = 2e-4  # second differences along the space planes' first axis, fine stage only
    time_smoothness: float = 1e-3  # second differences in t
    time_l1: float = 1e-4  # mean |1 - plane| of the time planes


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its learning rates. `*_lr` of positions, motion field and networks decay exponentially to `*_lr_end`."""

    means_lr: float = 1.6e-4
    means_lr_end: float = 1.6e-6
    heads_lr: float = 1.6e-4  # g and the mu, Q, S heads
    heads_lr_end: float = 1.6e-5
    planes_lr: float = 1.6e-3
    planes_lr_end: float = 1.6e-4
    ocd_lr: float = 1.6e-4
    ocd_lr_end: float = 1.6e-5
    bafe_lr: float = 1.6e-3
    bafe_lr_end: float = 1.6e-4
    extent_scales: tuple[str, ...] = ("means", "heads", "planes")  # groups whose rates are multiplied by the extent
    illumination_lr: float = 2.5e-3
    illumination_rest_divisor: float = 20.0
    reflectance_lr: float = 1e-5
    attenuation_lr: float = 1e-5
    opacity_lr: float = 0.05
    scales_lr: float = 5e-3
    quats_lr: float = 1e-3
    decay_steps: int | None = 20_000  # length of the decays; None: the length of the stage
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15


@dataclass(frozen=True)
class DensityConfig:
    """Clone, split and prune (3D Gaussian Splatting, arXiv 2308.04079, as 4DGS sets it)."""

    start: int = 500  # of each stage, steps
    stop: int = 10_000
    interval: int = 100
    grad_threshold: float = 2e-4  # mean norm of dL/d(mean2d), normalised device coordinates
    clone_below: float = 0.01  # of the extent; larger Gaussians split
    conserve_opacity: bool = False  # a new pair covers as much as its source did (arXiv 2404.06109)
    prune_opacity: float = 0.005
    prune_above: int = 0  # prune only when more Gaussians than this exist
    max_gaussians: int = 360_000


@dataclass(frozen=True)
class Config:
    """All settings of a training run; saved as `config.json` in its folder."""

    coarse_steps: int = 3000
    fine_steps: int = 20_000
    batch_size: int = 2  # views a step
    seed: int = 0
    downscale: int = 1  # reads images at 1/downscale of their full size
    format: Layout = "auto"  # of the scene's folder; "auto": found from its contents
    held_out: str = "auto"  # views not trained on: the scene's own, "4dgs", or k for every k-th (data/splits.py)
    sh_warmup: int = 1000  # steps between activating one more SH band
    checkpoint_every: int = 500  # steps
    frame_memory: float = 4.0  # GiB that a scene's frames may take; beyond it they lie in temporary files
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    density: DensityConfig = field(default_factory=DensityConfig)

    @property
    def steps(self) -> int:
        """Length of the whole run."""
        return self.coarse_steps + self.fine_steps


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
    # Scores: low-light PSNR / well-lit PSNR / well-lit SSIM on the held-out camera of a path-traced scene, 200x112.
    default = Config(
        # What two CPU cores do in a few minutes, at 36.2 / 24.0 / .84. Longer fits the noise of the training views:
        # 300 + 1,200 steps with growth ended at 35.9, 300 + 2,700 at 35.8 (training views at 41.6 dB).
        coarse_steps=600,
        fine_steps=600,
        model=ModelConfig(
            # With 128 and (1, 2, 4) a fine step took 1.3 times as long; the quality of the two was not compared.
            hidden=64,
            plane_scales=(1, 2),
            # What moves lies in the point cloud once for every moment that the points come from: each copy can now fade
            # where it does not belong. Step 1000, moving region, low light: 30.6 with, 29.6 without.
            opacity_head=True,
            # The fine stage then starts from the coarse stage's result instead of from a jump.
            identity_start=True,
            # Random: 29.0 / 18.5 / .49 after 600 coarse steps; observed: 32.9 / 20.7 / .73 after 400. Not a clean
            # comparison: the first run's SH warm-up was shorter and it grew just before it was scored.
            reflectance_init="observed",
            # The dark frame raised to 1 / B1 times its best gain scores 29.7 dB, the best gain alone 22.4 dB.
            initial_exponents=("auto", 9.0),
            initial_illumination="auto",
        ),
        loss=LossConfig(
            # As printed (R in 16x16 windows, SAR), a prototype stayed at 14 dB well lit: L_w saturates and every window
            # is pulled to grey. On the mean of I_w, without SAR and with smooth L_w it reached 20. The level is
            # photographers' middle grey, 18 % linear, in sRGB.
            exposure=1.0,
            exposure_level=0.46,
            exposure_of="welllit",
            exposure_window=None,
            exposure_form="squared",
            amplification=0.0,
            structure=0.1,
            illumination_tv=1.0,
            exponent_prior=0.2,
        ),
        optim=OptimConfig(
            # 1e-5 moves a reflectance by 0.03 in 3,000 steps: a prototype stayed at 24.8 / 8.3.
            reflectance_lr=5e-3,
            attenuation_lr=5e-3,
            # Motion must be learned in these steps. Step 1000, moving region, low light / well lit: 26.8 / 14.1 with
            # the paper's rates, 28.7 / 15.5 with heads and planes x3, 28.7 / 16.1 with heads x9 and OCD-Net x1/3,
            # 30.6 / 17.3 with planes x10 as well.
            heads_lr=1.5e-3,
            planes_lr=1.6e-2,
            ocd_lr=5e-5,
            decay_steps=2400,  # motion would end half learned if its rates fell to their end within 600 steps
        ),
        # No growth: each time is a shock that takes hundreds of steps to heal. In the coarse stage, and with clones of
        # full opacity, low light fell from 32.9 to 30.8 dB; over 2,700 fine steps, 80 % more Gaussians took the moving
        # region from 30.3 to 29.8 dB. A sparse point cloud, or more steps, may want --density.stop 1500.
        density=DensityConfig(start=200, stop=0, interval=200, grad_threshold=5e-4, conserve_opacity=True),
    )
    # A smaller motion field, for a few minutes on two cores.
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

# Settings of how a run is carried out, not of what it computes: they may change when it goes on.
EXECUTION = frozenset({"checkpoint_every", "frame_memory"})


def to_dict(config: Config) -> dict:
    """The settings as nested dictionaries of JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(values: dict) -> Config:
    """The inverse of `to_dict`.

    Raises:
        TypeError: a setting is unknown.
    """
    parts = {"model": ModelConfig, "loss": LossConfig, "optim": OptimConfig, "density": DensityConfig}
    tuples = lambda items: {key: tuple(v) if isinstance(v, list) else v for key, v in items.items()}
    return Config(**{key: parts[key](**tuples(v)) if key in parts else v for key, v in values.items()})
