"""All settings, as frozen dataclasses; the defaults are the paper's, where it gives any."""

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

# Settings that a compiled step may take as arguments are Python numbers outside it and traced scalars inside
# (`overrides.combine`); the command line parses them as the `_PLAIN_...` types.
_Float = float | Float[Array, ""]
_Int = int | Int[Array, ""]


def _arg(kind: Any) -> Any:
    return tyro.conf.arg(
        constructor=kind, help_behavior_hint=lambda shown: f"(default: {' '.join(map(str, ast.literal_eval(shown)))})"
    )


_PLAIN_NUMBER, _PLAIN_COUNT, _PLAIN_OPTIONAL_COUNT = float, int, int | None
_PLAIN_EXPONENTS = tuple[float | Literal["auto"], float] | None
_PLAIN_AUTO_COUNT = int | Literal["auto"]
_PLAIN_OPTIONAL_AUTO_NUMBER = float | Literal["auto"] | None
_PLAIN_AUTO_NUMBER = float | Literal["auto"]
_PLAIN_OPTIONAL_NUMBER = float | None
Number = Annotated[_Float, _arg(_PLAIN_NUMBER)]
Count = Annotated[_Int, _arg(_PLAIN_COUNT)]
OptionalCount = Annotated[_Int | None, _arg(_PLAIN_OPTIONAL_COUNT)]
Exponents = Annotated[tuple[_Float | Literal["auto"], _Float] | None, _arg(_PLAIN_EXPONENTS)]
AutoCount = Annotated[_Int | Literal["auto"], _arg(_PLAIN_AUTO_COUNT)]
OptionalAutoNumber = Annotated[_Float | Literal["auto"] | None, _arg(_PLAIN_OPTIONAL_AUTO_NUMBER)]
AutoNumber = Annotated[_Float | Literal["auto"], _arg(_PLAIN_AUTO_NUMBER)]
OptionalNumber = Annotated[_Float | None, _arg(_PLAIN_OPTIONAL_NUMBER)]
TRACEABLE: dict[Any, Any] = {
    Number: _PLAIN_NUMBER,
    Count: _PLAIN_COUNT,
    OptionalCount: _PLAIN_OPTIONAL_COUNT,
    Exponents: _PLAIN_EXPONENTS,
    AutoCount: _PLAIN_AUTO_COUNT,
    OptionalAutoNumber: _PLAIN_OPTIONAL_AUTO_NUMBER,
    AutoNumber: _PLAIN_AUTO_NUMBER,
    OptionalNumber: _PLAIN_OPTIONAL_NUMBER,
}

EPS = math.exp(-5)  # of Eq. 10
# Groups of parameters, each with one learning rate.
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

    # unit of lengths, and the extent that learning rates of positions scale with. "world": world units, and the radius
    # of the camera path as in 3DGS; "depth": a quarter of the median depth of the points, for both
    unit: Literal["world", "depth"] = "world"
    sh_degree: int = 3  # highest band k of the spherical harmonics (SH) of Eq. 2, which has (k + 1)^2 coefficients
    plane_size: int = 64  # HexPlane cells along each spatial axis, at the coarsest scale
    # factors on plane_size, one per scale of the HexPlane; the scales' features are concatenated. Time is not scaled
    plane_scales: tuple[int, ...] = (1, 2, 4)
    plane_channels: int = 16  # feature channels of a HexPlane cell
    box_points: Number = 1.0  # share of the points that the HexPlane's box spans along each axis
    # share of the HexPlane's cells for the (contracted) space outside its box; 0: points outside take the feature of
    # the nearest point of the box
    box_rim: float = 0.0
    time_size: int | None = None  # HexPlane cells along the time axis; None: half the number of instants
    # part of the time axis that is used: "upper" is its upper half, as in the authors' code, where planes are read at t
    # in [0, 1] as if it lay in [-1, 1]
    time_range: Literal["full", "upper"] = "full"
    # how the features of the six planes are combined: "paired_sum" as in Eq. 1, or the "product" of all six
    aggregation: Literal["paired_sum", "product"] = "paired_sum"
    hidden: int = 128  # width of the aggregation g (Eq. 1), of the motion heads and of OCD-Net
    # whether a fourth motion head changes the opacity (before its sigmoid) over time, as 4DGS can (arXiv 2310.08528)
    opacity_head: bool = False
    # factor by which an output x > 0 of the scale head enlarges a Gaussian: "exponential", exp(x), or "bounded",
    # exp(0.2 tanh(x / 0.2)), at most 1.22; x < 0 shrinks it by exp(x) either way
    scale_growth: Literal["exponential", "bounded"] = "exponential"
    # whether every Gaussian has a gate: a learned factor in (0, 1) on all that the motion field does to it
    motion_gate: bool = False
    shut_gates: float = 0.0  # a motion gate below this is shut for good: its Gaussian stands still
    # whether moving objects start with Gaussians of their own, found by tracking optical flow (training/seeds.py); each
    # has a path and a lifetime, and the motion field acts on top of these
    tracks: bool = False
    # whether to start with additional points on static surfaces, triangulated from optical flow (training/surfaces.py)
    surfaces: bool = False
    identity_start: bool = False  # whether motion heads and OCD-Net start with no motion and a_j = 1, not at random
    illumination_offset: Number = 0.5  # offset in a Gaussian's illumination l = max(offset + sum a_j b_j B_j, 0)
    # initial reflectances: "normal", N(0, 1); "uniform", U(0, 1); or "observed", the frames' colours at the points,
    # with the darkening that model/tone.py estimates undone
    reflectance_init: Literal["normal", "uniform", "observed"] = "uniform"
    bounded_reflectance: bool = False  # whether the Gaussians' reflectances are clipped to [0, 1] after every step
    attenuation_init: Literal["normal", "uniform"] = "uniform"  # initial b1 and b2 of Eq. 8: N(0, 1) or U(0, 1)
    # exponents B1 and B2 at the start; None: both 5.5, the middle of their range. "auto" for B1: derived from how dark
    # the frames are (model/tone.py)
    initial_exponents: Exponents = None
    # illumination l of every Gaussian at the start; None: luminance of its point; "auto": the L for which L^B2 is the
    # gain of the darkening that model/tone.py estimates
    initial_illumination: OptionalAutoNumber = None
    # how the frames became dark: "linear-light", too little light reached the sensor; "gain", their sRGB values were
    # multiplied by a factor; "auto", recognised from the frames (model/tone.py); or a number, the exponent of sRGB
    # values that B1 starts at if initial_exponents leaves it to "auto"
    tone: float | Literal["linear-light", "gain", "auto"] = "linear-light"
    # what Eqs. 7 and 9 multiply and raise to powers: sRGB "values", as in the paper, or linear "light"; "auto": light
    # if the tone is "linear-light"
    domain: Literal["values", "light", "auto"] = "values"
    # whether L_w is divided by initial_illumination in Eq. 7, so that the well-lit image can be as bright as R_w
    relative_light: bool = False
    initial_opacity: Number = 0.1  # opacity of every Gaussian at the start
    # whether the camera's exposure changed: "drifting", every training frame has a learned gain per colour channel;
    # "steady", it has none; "auto", drifting if the brightness of the points differs between frames
    exposure: Literal["steady", "drifting", "auto"] = "steady"
    background: float = 0.0  # value of L and R where nothing is drawn
    # "retinex": illumination and reflectance (Eqs. 5-9); "none": Gaussians have SH colours as in 4DGS (arXiv
    # 2310.08528), whose image is both the low-light and the well-lit one (Table 1, 4DGS); "curve": the image of the SH
    # colours is the well-lit one, and a learned tone curve of it the low-light one (model/tone_curves.py)
    decomposition: Literal["retinex", "none", "curve"] = "retinex"
    ocd: bool = True  # whether OCD-Net changes the illumination over time; otherwise a_j = 1 (Table 3, w/o OCD-Net)
    # whether B1 and B2 come from BAFE-Net; otherwise they are the blended b1 and b2, mapped to the same range (Table 3,
    # w/o BAFE-Net)
    bafe: bool = True
    unit_exponent: Literal["b1", "b2"] | None = None  # the exponent that is fixed at 1 (Table 3, B1 = 1 and B2 = 1)

    def __post_init__(self) -> None:
        if self.domain == "light" and isinstance(self.tone, float | int):
            raise UserError(f"--model.tone {self.tone}: applies to sRGB values; expected --model.domain values or auto")


@dataclass(frozen=True)
class LossConfig:
    """Weights and forms of Eqs. 10-15, of the plane regularisers, and of terms that the paper does not have."""

    # images that the L1 term of Eq. 10 compares: "raw", I itself, or "tonemapped", (I + eps)^eta as in the SSIM term
    l1_on: Literal["raw", "tonemapped"] = "raw"
    ssim: Number = 1.0  # weight of 1 - SSIM in Eq. 10
    eps: Number = EPS  # epsilon of Eq. 10
    eta_start: Number = 0.95  # exponent eta of Eq. 10 at the start
    eta_end: Number = 0.5  # exponent eta of Eq. 10 at the end
    eta_restarts: bool = False  # whether the decay of eta starts again with the fine stage
    exposure: Number = 0.01  # lambda_1: weight of the exposure loss (Eq. 11)
    # mean brightness (sRGB) that Eq. 11 asks for: raise or lower it for a brighter or darker result. "auto": mid-grey,
    # or less where highlights would clip (model/tone.py)
    exposure_level: AutoNumber = 0.6
    exposure_of: Literal["reflectance", "welllit"] = "reflectance"  # image whose brightness Eq. 11 controls, R_w or I_w
    exposure_window: int | None = 16  # side in pixels of the blocks whose means Eq. 11 takes; None: the whole image
    exposure_form: Literal["absolute", "squared"] = "absolute"  # penalty of Eq. 11 on the difference from the level
    amplification: Number = 0.05  # lambda_2: weight of mean |1 - L_w| (Eq. 13)
    # weight of mean |1 - R_w|, in addition to Eq. 13 or instead of it (Table 3, L + 0.05 |1 - R_w| and Maximize R_w)
    reflectance_amplification: Number = 0.0
    structure: Number = 1.0  # lambda_3: weight of the structure loss (Eq. 14) between B1 and R_w
    structure_illumination: OptionalNumber = None  # lambda_4: the same between B2 and L_w; None: as lambda_3
    structure_beta: Number = 0.5  # beta_1 of Eq. 14: factor on B1's gradient
    structure_beta_illumination: OptionalNumber = None  # beta_2 of Eq. 14: factor on B2's gradient; None: as beta_1
    # gradients in Eq. 14: forward differences in x and y, or sqrt(dx^2 + dy^2) of central differences
    structure_gradient: Literal["components", "magnitude"] = "components"
    depth: Number = 0.001  # lambda_5: weight of the edge-aware smoothness of depth (Eq. 12)
    depth_gradient: Literal["forward", "sobel"] = "forward"  # gradients in Eq. 12: forward differences or Sobel filters
    depth_gain: Number = 1.0  # factor on the depth D in Eq. 12
    depth_input: Number = 0.0  # weight of the difference from the scene's own depth maps (training/given_depth.py)
    illumination_tv: Number = 0.0  # weight of the total variation of L_w
    exponent_prior: Number = 0.0  # weight of mean |B1 - initial B1|
    # weight of squared second differences of the HexPlane's space planes along their first axis; fine stage only
    plane_smoothness: Number = 2e-4
    time_smoothness: Number = 1e-3  # weight of squared second differences of the time planes in time; fine stage only
    time_l1: Number = 1e-4  # weight of mean |1 - plane| of the HexPlane's time planes; fine stage only
    opacity: Number = 0.0  # weight of the mean opacity
    scale: Number = 0.0  # weight of the mean scale, in the unit of lengths
    gate: Number = 0.0  # weight of the mean motion gate; fine stage only
    # weight of how much neighbours change their distances over time (training/rigidity.py); fine stage only
    rigidity: Number = 0.0
    # with tone curves: weight of their distance from curves that give well-lit images a flat histogram
    equalisation: Number = 0.0
    # with tone curves: weight of their distance from power laws
    bend: Number = 0.0


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its learning rates. A rate `*_lr` with a `*_lr_end` decays to it exponentially; others are constant."""

    means_lr: Number = 1.6e-4  # learning rate of the Gaussians' centres
    means_lr_end: Number = 1.6e-6  # final learning rate of the Gaussians' centres
    heads_lr: Number = 1.6e-4  # learning rate of the aggregation g and the motion heads (Eq. 1)
    heads_lr_end: Number = 1.6e-5  # final learning rate of the aggregation g and the motion heads (Eq. 1)
    planes_lr: Number = 1.6e-3  # learning rate of the HexPlane
    planes_lr_end: Number = 1.6e-4  # final learning rate of the HexPlane
    ocd_lr: Number = 1.6e-4  # learning rate of OCD-Net
    ocd_lr_end: Number = 1.6e-5  # final learning rate of OCD-Net
    bafe_lr: Number = 1.6e-3  # learning rate of BAFE-Net
    bafe_lr_end: Number = 1.6e-4  # final learning rate of BAFE-Net
    # groups of parameters, such as means or paths, whose learning rates are multiplied by the extent (see model.unit)
    extent_scales: tuple[str, ...] = ("means", "heads", "planes")
    illumination_lr: Number = 2.5e-3  # learning rate of the constant SH coefficient of the illumination
    illumination_rest_divisor: Number = 20.0  # illumination_lr divided by this is the rate of the higher SH bands
    reflectance_lr: Number = 1e-5  # learning rate of the reflectances
    attenuation_lr: Number = 1e-5  # learning rate of b1 and b2 (Eq. 8)
    opacity_lr: Number = 0.05  # learning rate of the opacities
    scales_lr: Number = 5e-3  # learning rate of the scales
    quats_lr: Number = 1e-3  # learning rate of the rotations
    gate_lr: Number = 0.01  # learning rate of the motion gates
    paths_lr: Number = 1e-3  # learning rate of the paths of tracked Gaussians (model.tracks)
    lifetimes_lr: Number = 0.0  # learning rate of the lifetimes of tracked Gaussians (model.tracks)
    exposures_lr: Number = 1e-3  # learning rate of the gains of the training frames (model.exposure)
    curves_lr: Number = 1e-3  # learning rate of the tone curves (model.decomposition)
    decay_steps: OptionalCount = 20_000  # steps that a decay takes; None: the length of the stage
    cooldown: Number = 0.0  # share of the run at its end in which all learning rates fall linearly to 0
    beta1: Number = 0.9  # decay of Adam's first moment
    beta2: Number = 0.999  # decay of Adam's second moment
    eps: Number = 1e-15  # added to the root of Adam's second moment

    def __post_init__(self) -> None:
        unknown = sorted(set(self.extent_scales) - set(RATE_GROUPS))
        if unknown:
            raise UserError(f"--optim.extent-scales {unknown[0]}: expected some of {', '.join(RATE_GROUPS)}")


@dataclass(frozen=True)
class DensityConfig:
    """Densification: how Gaussians are added, moved and removed."""

    # "adaptive": clone, split and prune (3D Gaussian Splatting, arXiv 2308.04079, as in 4DGS); "mcmc": relocate faint
    # Gaussians, add new ones up to max_gaussians, and disturb them by noise (arXiv 2404.09591)
    method: Literal["adaptive", "mcmc"] = "adaptive"
    start: int = 500  # step of each stage after which densification begins
    stop: int = 10_000  # step of each stage from which on there is no densification
    interval: int = 100  # steps between two densifications
    # "adaptive": mean norm of dL/d(mean2d), in normalised device coordinates, from which a Gaussian is cloned or split
    grad_threshold: Number = 2e-4
    # "adaptive": scale, relative to the extent, up to which a Gaussian is cloned; larger ones are split
    clone_below: Number = 0.01
    # "adaptive": whether a clone or split lowers opacities so that the pair covers what one did (arXiv 2404.06109)
    conserve_opacity: bool = False
    prune_opacity: Number = 0.005  # opacity below which a Gaussian is removed ("adaptive") or relocated ("mcmc")
    prune_above: Count = 0  # "adaptive": remove Gaussians only while there are more than this
    # largest number of Gaussians, unless the scene starts with more; "auto": 0.6 to 1.5 per pixel of a frame, at most
    # 360,000
    max_gaussians: AutoCount = 360_000
    noise: Number = 5e5  # "mcmc": strength of the noise on centres of faint Gaussians, as a factor on means_lr
    # "mcmc": which Gaussians are copied: in proportion to opacity, or with "gradient" to opacity times the summed norm
    # of dL/d(mean2d)
    drawn_by: Literal["opacity", "gradient"] = "opacity"
    spread: float = 0.0  # "mcmc": standard deviation of copies about their source, relative to their scales

    def __post_init__(self) -> None:
        if not 0 <= self.spread < 1:
            raise UserError(f"--density.spread {self.spread}: expected at least 0 and less than 1")


@dataclass(frozen=True)
class Config:
    """All settings of a training run; saved as `config.json` in its folder."""

    coarse_steps: int = 3000  # steps of the coarse stage, in which the motion field does not act
    fine_steps: int = 20_000  # steps of the fine stage, in which the motion field acts
    batch_size: int = 2  # views per step
    seed: Count = 0  # seed of everything random
    downscale: int = 1  # integer factor by which to shrink the images
    format: Layout = "auto"  # layout of the scene's folder; "auto" recognises it from its contents
    # views not trained on: "auto" (the scene's own, or else the layout's rule), "4dgs", or a number k for every k-th
    # frame (docs/data.md)
    held_out: str = "auto"
    normalise: bool = True  # whether a Nerfies scene is centred and scaled as its scene.json says; 4DGS does not do so
    sh_warmup: int | None = 1000  # steps after which one more SH band is used; None: all are used after half of the run
    drop: Number = 0.0  # share of the Gaussians that a step leaves out at random; grows from 0 to this over the run
    checkpoint_every: int = 500  # steps between checkpoints
    keep_checkpoints: int = 2  # number of checkpoints to keep, in case the last one is damaged
    # share of the training views that lie between two frames, synthesised by optical flow (training/inbetweens.py)
    inbetweens: float = 0.0
    # how the frames are brightened before training, for a model of well-lit frames (preprocess/enhancement.py)
    enhance: Enhancement = "none"
    frame_memory: float = 4.0  # GiB of memory for the scene's frames; if they take more, they go to temporary files
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    density: DensityConfig = field(default_factory=DensityConfig)

    @property
    def steps(self) -> int:
        """Length of the whole run."""
        return self.coarse_steps + self.fine_steps

    @property
    def reading(self) -> dict[str, Any]:
        """How a scene is read: arguments of `load_dataset`."""
        names = ("downscale", "format", "held_out", "frame_memory", "normalise")
        return {name: getattr(self, name) for name in names}

    def stage_of(self, step: int) -> str:
        """The stage that a step belongs to; steps are numbered from 1."""
        return "coarse" if step <= self.coarse_steps else "fine"

    def check(self) -> None:
        """Check the ranges of numbers; not when settings are made, as the numbers may then be placeholders or traced.

        Raises:
            UserError: a number is out of range.
        """
        model, window = self.model, self.loss.exposure_window
        parts = {"": self, "model.": model, "loss.": self.loss, "optim.": self.optim, "density.": self.density}
        for name, value in ((f"{part}{name}", value) for part, of in parts.items() for name, value in vars(of).items()):
            if isinstance(value, float) and not math.isfinite(value):
                raise UserError(f"--{name.replace('_', '-')} {value}: expected a finite number")
        for name, count, least in (
            ("--batch-size", self.batch_size, 1),
            ("--checkpoint-every", self.checkpoint_every, 1),
            ("--keep-checkpoints", self.keep_checkpoints, 1),
            ("--downscale", self.downscale, 1),
            ("--density.interval", self.density.interval, 1),
            ("--loss.exposure-window", window, 1),
            ("--model.hidden", model.hidden, 1),
            ("--model.plane-channels", model.plane_channels, 1),
            ("--model.plane-scales", min(model.plane_scales, default=0), 1),
            ("--model.plane-size", model.plane_size, 2),
            ("--model.time-size", model.time_size, 2),
        ):
            if count is not None and count < least:
                raise UserError(f"{name} {count}: expected at least {least}")
        for name, value, fits, expected in (
            ("--seed", self.seed, 0 <= self.seed < 2**31, "a whole number from 0 below 2^31"),
            ("--inbetweens", self.inbetweens, 0 <= self.inbetweens < 1, "at least 0 and less than 1"),
            ("--drop", self.drop, 0 <= self.drop < 1, "at least 0 and less than 1"),
            ("--loss.eps", self.loss.eps, self.loss.eps >= 0, "at least 0"),
            ("--optim.cooldown", self.optim.cooldown, 0 <= self.optim.cooldown <= 1, "from 0 to 1"),
            ("--model.shut-gates", model.shut_gates, 0 <= model.shut_gates < 1, "at least 0 and less than 1"),
            ("--model.box-rim", model.box_rim, 0 <= model.box_rim < 1, "at least 0 and less than 1"),
            ("--model.box-points", model.box_points, 0 < model.box_points <= 1, "more than 0 and at most 1"),
            ("--model.initial-opacity", model.initial_opacity, 0 < model.initial_opacity < 1, "between 0 and 1"),
            ("--model.sh-degree", model.sh_degree, 0 <= model.sh_degree <= 3, "a whole number from 0 to 3"),
            ("--model.tone", model.tone, _is_exponent(model.tone), "an exponent between 1 and 10, or a name"),
            (
                "--model.initial-illumination",
                model.initial_illumination,
                not (model.relative_light and model.initial_illumination is None),
                'a number or "auto", which --model.relative-light divides by',
            ),
        ):
            if not fits:
                raise UserError(f"{name} {value}: expected {expected}")
        for value in model.initial_exponents or ():
            if not _is_exponent(value):
                raise UserError(f"--model.initial-exponents {value}: expected exponents between 1 and 10")
        if self.steps < 1 or min(self.coarse_steps, self.fine_steps) < 0:
            raise UserError("--coarse-steps and --fine-steps: expected no negative number and at least one step in all")


def _is_exponent(value: Any) -> bool:
    """Whether BAFE-Net can give an exponent (Eq. 9), or it is left to be determined."""
    return isinstance(value, str) or 1 < value < 10


# Settings of how a run is carried out, not of what it computes: they may change when it is resumed.
EXECUTION = frozenset({"checkpoint_every", "frame_memory", "keep_checkpoints"})


def to_dict(config: Config) -> dict:
    """The settings as nested dictionaries of JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config)))
