"""Every setting, as frozen dataclasses; the defaults are the paper's, where it gives any."""

import ast
import dataclasses
import json
import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro
from jaxtyping import Array, Float, Int

from l2dgs_jax.errors import UserError

LayoutName = Literal["nerfies", "colmap", "transforms", "llff"]
Layout = Literal["auto"] | LayoutName
Enhancement = Literal["none", "gamma", "clahe", "zero-dce"]

# Settings that a compiled step may take as arguments are numbers outside of it and traced scalars inside
# (`overrides.combine`); the command line reads the plain kinds.
_Float = float | Float[Array, ""]
_Int = int | Int[Array, ""]


def _arg(kind: Any) -> Any:
    return tyro.conf.arg(
        constructor=kind, help_behavior_hint=lambda shown: f"(default: {' '.join(map(str, ast.literal_eval(shown)))})"
    )


_PLAIN_NUMBER, _PLAIN_COUNT, _PLAIN_LENGTH = float, int, int | None
_PLAIN_EXPONENTS = tuple[float | Literal["auto"], float] | None
_PLAIN_MOST = int | Literal["auto"]
_PLAIN_ILLUMINATION = float | Literal["auto"] | None
_PLAIN_LEVEL = float | Literal["auto"]
_PLAIN_OPTIONAL = float | None
Number = Annotated[_Float, _arg(_PLAIN_NUMBER)]
Count = Annotated[_Int, _arg(_PLAIN_COUNT)]
Length = Annotated[_Int | None, _arg(_PLAIN_LENGTH)]
Exponents = Annotated[tuple[_Float | Literal["auto"], _Float] | None, _arg(_PLAIN_EXPONENTS)]
Most = Annotated[_Int | Literal["auto"], _arg(_PLAIN_MOST)]
Illumination = Annotated[_Float | Literal["auto"] | None, _arg(_PLAIN_ILLUMINATION)]
Level = Annotated[_Float | Literal["auto"], _arg(_PLAIN_LEVEL)]
OptionalNumber = Annotated[_Float | None, _arg(_PLAIN_OPTIONAL)]
TRACEABLE: dict[Any, Any] = {
    Number: _PLAIN_NUMBER,
    Count: _PLAIN_COUNT,
    Length: _PLAIN_LENGTH,
    Exponents: _PLAIN_EXPONENTS,
    Most: _PLAIN_MOST,
    Illumination: _PLAIN_ILLUMINATION,
    Level: _PLAIN_LEVEL,
    OptionalNumber: _PLAIN_OPTIONAL,
}

EPS = math.exp(-5)  # of Eq. 10
# Parameters that share a learning rate.
RATE_GROUPS = (
    "means",
    "heads",
    "planes",
    "ocd",
    "bafe",
    "illumination",
    "illumination_rest",
    "reflectance",
    "attenuation",
    "opacities",
    "scales",
    "quats",
    "gate",
    "paths",
    "lifetimes",
    "exposures",
    "curves",
)


@dataclass(frozen=True)
class ModelConfig:
    """Shape and initial state of a scene."""

    # What lengths are measured in, and what the extent is that rates of positions scale with: "world" units, and the
    # radius of the camera path (3DGS); or "depth", a quarter of the median depth of the points, for both.
    unit: Literal["world", "depth"] = "world"
    sh_degree: int = 3  # bands k of Eq. 2; (k+1)^2 coefficients
    plane_size: int = 64  # cells of a spatial axis at the coarsest scale
    plane_scales: tuple[int, ...] = (1, 2, 4)  # factors on plane_size, concatenated; time is never scaled
    plane_channels: int = 16  # of the feature that a cell holds
    box_points: Number = 1.0  # share of the points, along each axis, that the planes' box spans
    box_rim: float = 0.0  # share of the planes' cells for what lies beyond, contracted; 0: it takes the box's border
    time_size: int | None = None  # cells of the time axis; None: half the number of training frames
    time_range: Literal["full", "upper"] = "full"  # "upper": t in [0, 1] read as [-1, 1], half of each time plane
    aggregation: Literal["paired_sum", "product"] = "paired_sum"  # Eq. 1, or the product of all six planes
    hidden: int = 128  # width of g, of the heads and of OCD-Net
    opacity_head: bool = False  # a fourth head moves the opacity's logit, as 4DGS can (arXiv 2310.08528)
    # How a Gaussian's scales grow with what their head adds; "linear": by a factor of 1 + x instead of exp(x)
    scale_growth: Literal["exponential", "linear"] = "exponential"
    motion_gate: bool = False  # a factor a Gaussian in (0, 1) on all that the motion field does to it
    # With gates: share of the Gaussians that the motion field acts on at once, those whose gates are open widest
    moving_share: float = 1.0
    # Whether what moves starts as Gaussians with paths and lifetimes of their own, from tracks of optical flow
    # (training/seeds.py); the motion field acts on top
    tracks: bool = False
    # Whether points on what stands still are added where flow tells how far away it is (training/surfaces.py)
    surfaces: bool = False
    identity_start: bool = False  # heads and OCD-Net start as "no motion, a_j = 1" instead of at random
    illumination_offset: Number = 0.5  # l = max(offset + sum a_j b_j B_j, 0)
    # N(0, 1), U(0, 1), or the frames' colours at the points, with the darkening of model/tone.py undone
    reflectance_init: Literal["normal", "uniform", "observed"] = "uniform"
    # Whether reflectances stay in [0, 1] after every step, those of Gaussians as those of images
    bounded_reflectance: bool = False
    attenuation_init: Literal["normal", "uniform"] = "uniform"  # N(0, 1) or U(0, 1)
    # B1, B2 that BAFE-Net starts at; None: zero bias, 5.5. B1 "auto": what the frames' darkness implies (model/tone.py)
    initial_exponents: Exponents = None
    # l of every Gaussian at the start; None: luminance of the points. "auto": what makes L^B2 the darkening's gain
    initial_illumination: Illumination = None
    # How the frames became dark: "linear-light", by little light; "gain", by a factor on their sRGB values; "auto",
    # what they look like (model/tone.py); or a number, the exponent that B1 starts at where it is "auto"
    tone: float | Literal["linear-light", "gain", "auto"] = "linear-light"
    # What Eqs. 7 and 9 speak of: sRGB "values", as in the paper, or the "light" that they stand for, of which a camera
    # in the dark gets a part; "auto": light if that is what `tone` says
    domain: Literal["values", "light", "auto"] = "values"
    relative_light: bool = False  # in Eq. 7, L_w over what it starts from: I_w need not be darker than that
    initial_opacity: Number = 0.1  # of every Gaussian
    # Whether every training frame has a gain of its own, learned beside the scene; "auto": if the points say so
    exposure: Literal["steady", "drifting", "auto"] = "steady"
    background: float = 0.0  # value of L and R where nothing is drawn
    # "retinex": Eqs. 5-9; "none": colours by spherical harmonics, as 4DGS (arXiv 2310.08528) has them, are both the
    # low-light and the well-lit image (Table 1, 4DGS); "curve": they are the well-lit image, and a learned tone curve
    # of it is the low-light one (model/tone_curves.py)
    decomposition: Literal["retinex", "none", "curve"] = "retinex"
    ocd: bool = True  # whether OCD-Net lights Gaussians anew at every instant; otherwise a_j = 1 (Table 3, w/o OCD-Net)
    # Whether B1 and B2 come from BAFE-Net; otherwise from the blended features alone, brought to the same range (Table
    # 3, w/o BAFE-Net)
    bafe: bool = True
    unit_exponent: Literal["b1", "b2"] | None = None  # the exponent that is 1 throughout (Table 3, B1 = 1 and B2 = 1)

    def __post_init__(self) -> None:
        if not 0 < self.moving_share <= 1:
            raise UserError(f"--model.moving-share {self.moving_share}: expected more than 0 and at most 1")


@dataclass(frozen=True)
class LossConfig:
    """Weights and forms of Eqs. 10-15 and of the plane regularisers."""

    l1_on: Literal["raw", "tonemapped"] = "raw"  # first term of Eq. 10 on I, or on (I + eps)^eta like the second
    ssim: Number = 1.0  # weight of 1 - SSIM in Eq. 10
    eps: Number = EPS  # of Eq. 10
    eta_start: Number = 0.95  # exponent of Eq. 10 at the start
    eta_end: Number = 0.5  # the same at the end
    eta_restarts: bool = False  # the decay starts anew with the fine stage
    exposure: Number = 0.01  # lambda_1, Eq. 11
    # Mean brightness that Eq. 11 asks for, sRGB: the knob for a brighter or darker result. "auto": mid-grey, or what
    # keeps highlights from clipping (model/tone.py)
    exposure_level: Level = 0.6
    exposure_of: Literal["reflectance", "welllit"] = "reflectance"  # the image whose brightness that is
    exposure_window: int | None = 16  # pixels; None: the mean of the whole image
    exposure_form: Literal["absolute", "squared"] = "absolute"  # what the difference counts as
    amplification: Number = 0.05  # lambda_2, Eq. 13
    # Weight of mean |1 - R_w|, beside Eq. 13 or instead of it (Table 3, L + 0.05 |1 - R_w| and Maximize R_w)
    reflectance_amplification: Number = 0.0
    structure: Number = 1.0  # lambda_3, Eq. 14
    structure_illumination: OptionalNumber = None  # lambda_4, Eq. 14; None: as lambda_3
    structure_beta: Number = 0.5  # beta_1, Eq. 14
    structure_beta_illumination: OptionalNumber = None  # beta_2, Eq. 14; None: as beta_1
    structure_gradient: Literal["components", "magnitude"] = "components"  # forward differences, or sqrt(dx^2 + dy^2)
    depth: Number = 0.001  # lambda_5, Eq. 12
    depth_gradient: Literal["forward", "sobel"] = "forward"  # differences in Eq. 12
    depth_gain: Number = 1.0  # factor on D inside Eq. 12
    depth_input: Number = 0.0  # difference from the scene's own depth, if it has any (training/given_depth.py)
    illumination_tv: Number = 0.0  # mean |forward difference| of L_w
    exponent_prior: Number = 0.0  # mean |B1 - initial B1|
    plane_smoothness: Number = 2e-4  # second differences along the space planes' first axis, fine stage only
    time_smoothness: Number = 1e-3  # second differences in t
    time_l1: Number = 1e-4  # mean |1 - plane| of the time planes
    opacity: Number = 0.0  # mean opacity
    scale: Number = 0.0  # mean scale, in the unit of lengths
    gate: Number = 0.0  # mean factor on motion, fine stage only
    # With tone curves: how far they are from those that leave well-lit images flat histograms, and from power laws
    equalisation: Number = 0.0
    bend: Number = 0.0


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its learning rates. `*_lr` of positions, motion field and networks decay exponentially to `*_lr_end`."""

    means_lr: Number = 1.6e-4
    means_lr_end: Number = 1.6e-6
    heads_lr: Number = 1.6e-4  # g and the mu, Q, S heads
    heads_lr_end: Number = 1.6e-5
    planes_lr: Number = 1.6e-3
    planes_lr_end: Number = 1.6e-4
    ocd_lr: Number = 1.6e-4
    ocd_lr_end: Number = 1.6e-5
    bafe_lr: Number = 1.6e-3
    bafe_lr_end: Number = 1.6e-4
    extent_scales: tuple[str, ...] = ("means", "heads", "planes")  # RATE_GROUPS whose rates the extent multiplies
    illumination_lr: Number = 2.5e-3
    illumination_rest_divisor: Number = 20.0  # of illumination_lr, for the higher bands
    reflectance_lr: Number = 1e-5
    attenuation_lr: Number = 1e-5
    opacity_lr: Number = 0.05
    scales_lr: Number = 5e-3
    quats_lr: Number = 1e-3
    gate_lr: Number = 0.01
    paths_lr: Number = 1e-3
    lifetimes_lr: Number = 0.0
    exposures_lr: Number = 1e-3
    curves_lr: Number = 1e-3
    decay_steps: Length = 20_000  # length of the decays; None: the length of the stage
    beta1: Number = 0.9
    beta2: Number = 0.999
    eps: Number = 1e-15

    def __post_init__(self) -> None:
        unknown = sorted(set(self.extent_scales) - set(RATE_GROUPS))
        if unknown:
            raise UserError(f"--optim.extent-scales {unknown[0]}: expected some of {', '.join(RATE_GROUPS)}")


@dataclass(frozen=True)
class DensityConfig:
    """How the number of Gaussians follows the image."""

    # "adaptive": clone, split and prune (3D Gaussian Splatting, arXiv 2308.04079, as 4DGS sets it); "mcmc": relocation
    # and noise in a fixed capacity (arXiv 2404.09591)
    method: Literal["adaptive", "mcmc"] = "adaptive"
    start: int = 500  # steps of each stage before it changes
    stop: int = 10_000  # steps of each stage after which it stays
    interval: int = 100  # steps between two changes
    grad_threshold: Number = 2e-4  # mean norm of dL/d(mean2d), normalised device coordinates
    clone_below: Number = 0.01  # of the extent; larger Gaussians split
    conserve_opacity: bool = False  # a new pair covers as much as its source did (arXiv 2404.06109)
    prune_opacity: Number = 0.005  # below it a Gaussian is removed, or moved to where it is needed
    prune_above: Count = 0  # prune only when more Gaussians than this exist
    max_gaussians: Most = 360_000  # "auto": 0.6 to 1 a pixel of a frame, no more than that, at least the points
    noise: Number = 5e5  # "mcmc": on the centres of faint Gaussians, times their learning rate
    # "mcmc": which Gaussians have copies; "gradient": by opacity times the summed norm of dL/d(mean2d)
    drawn_by: Literal["opacity", "gradient"] = "opacity"
    spread: float = 0.0  # "mcmc": of a Gaussian's copies about it, in its standard deviations

    def __post_init__(self) -> None:
        if not 0 <= self.spread < 1:
            raise UserError(f"--density.spread {self.spread}: expected at least 0 and less than 1")


@dataclass(frozen=True)
class Config:
    """All settings of a training run; saved as `config.json` in its folder."""

    coarse_steps: int = 3000  # of the first stage, in which nothing moves
    fine_steps: int = 20_000  # of the second, in which things do
    batch_size: int = 2  # views a step
    seed: Count = 0  # of all that is random
    downscale: int = 1  # reads images at 1/downscale of their full size
    format: Layout = "auto"  # of the scene's folder; "auto": found from its contents
    held_out: str = "auto"  # views not trained on: the scene's own, "4dgs", or k for every k-th (data/splits.py)
    sh_warmup: int | None = 1000  # steps between activating one more SH band; None: all by half of the run
    drop: Number = 0.0  # share of the Gaussians that a step leaves out at random, at the end of the run
    checkpoint_every: int = 500  # steps between checkpoints
    keep_checkpoints: int = 2  # how many of the last ones stay, in case that the very last is damaged
    # Share of the views that lie between two frames of the video, drawn by optical flow (training/inbetweens.py)
    inbetweens: float = 0.0
    # How the frames are brightened before training, where low light is not modelled (preprocess/enhancement.py)
    enhance: Enhancement = "none"
    frame_memory: float = 4.0  # GiB that a scene's frames may take; beyond it they lie in temporary files
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    density: DensityConfig = field(default_factory=DensityConfig)

    @property
    def steps(self) -> int:
        """Length of the whole run."""
        return self.coarse_steps + self.fine_steps

    def stage_of(self, step: int) -> str:
        """The stage that the step of that number, from 1, belongs to."""
        return "coarse" if step <= self.coarse_steps else "fine"

    def check_counts(self) -> None:
        """Complain of numbers that make no training.

        Raises:
            UserError: a number of steps is negative, or both are zero; a step has no views; no number of steps lies
                between checkpoints; or none is kept.
        """
        for name, count in (
            ("--batch-size", self.batch_size),
            ("--checkpoint-every", self.checkpoint_every),
            ("--keep-checkpoints", self.keep_checkpoints),
        ):
            if count < 1:
                raise UserError(f"{name} {count}: expected at least 1")
        if self.steps < 1 or min(self.coarse_steps, self.fine_steps) < 0:
            raise UserError("--coarse-steps and --fine-steps: expected no negative number and at least one step in all")


# Settings of how a run is carried out, not of what it computes: they may change when it goes on.
EXECUTION = frozenset({"checkpoint_every", "frame_memory", "keep_checkpoints"})


def to_dict(config: Config) -> dict:
    """The settings as nested dictionaries of JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(values: dict) -> Config:
    """The inverse of `to_dict`.

    Raises:
        TypeError: a setting is unknown.
    """
    parts = {"model": ModelConfig, "loss": LossConfig, "optim": OptimConfig, "density": DensityConfig}
    return Config(**{key: parts[key](**_with_tuples(v)) if key in parts else v for key, v in values.items()})


def _with_tuples(values: dict[str, Any]) -> dict[str, Any]:
    """Tuples again where JSON has made lists of them."""
    return {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
