"""The containers that are passed between the package's functions: NamedTuples of arrays, without static fields."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class Camera(NamedTuple):
    """One pinhole camera, or a batch of them, at an instant.

    Axes are OpenCV's (x right, y down, z forward) and pixel centres lie at +0.5.

    Attributes:
        viewmat: rigid world-to-camera matrix.
        K: intrinsics in pixels.
        time: instant in [0, 1], 0 being the first frame and 1 the last.
    """

    viewmat: Float[Array, "*B 4 4"]
    K: Float[Array, "*B 3 3"]
    time: Float[Array, "*B"]


class Gaussians(NamedTuple):
    """Canonical Gaussians, raw (before activation): what the optimizer sees.

    Attributes:
        means: centres in world units.
        quats: rotations, wxyz, any norm.
        log_scales: logarithms of the standard deviations along the principal axes.
        logit_opacities: opacity before the sigmoid.
        illumination_dc: SH coefficient b_1 of Eq. 2.
        illumination_rest: SH coefficients b_2 ... b_J of Eq. 2.
        reflectance: r of Eq. 6.
        attenuation: brightness attenuation features (b1, b2) of Eq. 8.
        gate: logit of a factor in (0, 1) on all that the motion field does to a Gaussian; None: no gates, factor 1.
        lifetimes: first and last instant at which a Gaussian with a path is visible; infinite for those without a path;
            None: no Gaussian has one.
        color_rest: SH coefficients 2 ... J of the colour, of which `reflectance` is the constant part, in scenes
            without a decomposition; None in the others.
    """

    means: Float[Array, "*B N 3"]
    quats: Float[Array, "*B N 4"]
    log_scales: Float[Array, "*B N 3"]
    logit_opacities: Float[Array, "*B N"]
    illumination_dc: Float[Array, "*B N 1"]
    illumination_rest: Float[Array, "*B N J1"]
    reflectance: Float[Array, "*B N 3"]
    attenuation: Float[Array, "*B N 2"]
    gate: Float[Array, "*B N"] | None = None
    lifetimes: Float[Array, "*B N 2"] | None = None
    color_rest: Float[Array, "*B N 3 J1"] | None = None


class MovedGaussians(NamedTuple):
    """Gaussians at an instant, activated: what the rasterizer sees.

    Attributes:
        means: centres in world units.
        quats: rotations, wxyz, any norm.
        scales: standard deviations in world units.
        opacities: in [0, 1]; exactly 0 for rows that are not alive.
        illumination: l of Eq. 3, seen from the camera of that instant.
        reflectance: r of Eq. 6, or in scenes without a decomposition the colour seen from the camera of that instant.
        attenuation: (b1, b2) of Eq. 8.
    """

    means: Float[Array, "*B N 3"]
    quats: Float[Array, "*B N 4"]
    scales: Float[Array, "*B N 3"]
    opacities: Float[Array, "*B N"]
    illumination: Float[Array, "*B N"]
    reflectance: Float[Array, "*B N 3"]
    attenuation: Float[Array, "*B N 2"]


class Linear(NamedTuple):
    """An affine layer y = x @ weight + bias."""

    weight: Float[Array, "*B I O"]
    bias: Float[Array, "*B O"]


class Conv(NamedTuple):
    """A 2D convolution, kernel in HWIO order."""

    weight: Float[Array, "*B k k I O"]
    bias: Float[Array, "*B O"]


class GroupNorm(NamedTuple):
    """Per-channel affine part of a group normalisation."""

    scale: Float[Array, "*B C"]
    bias: Float[Array, "*B C"]


class HexPlane(NamedTuple):
    """Six feature planes per scale (Eq. 1), channels last.

    Attributes:
        space: per scale, the planes XY, YZ, ZX; the axis named first is the first one.
        time: per scale, the planes Zt, Xt, Yt, paired with `space` in that order; time is the first axis.
    """

    space: tuple[Float[Array, "*B 3 S S C"], ...]
    time: tuple[Float[Array, "*B 3 T S C"], ...]


class MotionHeads(NamedTuple):
    """The aggregation g of Eq. 1 and the mu, Q and S heads, two affine layers each; optionally one for the opacity."""

    aggregate: Linear
    mean: tuple[Linear, Linear]
    quat: tuple[Linear, Linear]
    scale: tuple[Linear, Linear]
    opacity: tuple[Linear, Linear] | None


class Motion(NamedTuple):
    """What the heads add to raw parameters at an instant; `logit_opacities` is None without the opacity head."""

    means: Float[Array, "*B 3"]
    quats: Float[Array, "*B 4"]
    log_scales: Float[Array, "*B 3"]
    logit_opacities: Float[Array, "*B"] | None


class OCDNet(NamedTuple):
    """Occlusion-disocclusion network (Eq. 4)."""

    hidden: Linear
    out: Linear


class BAFENet(NamedTuple):
    """Brightness attenuation feature enhancement network (between Eqs. 8 and 9)."""

    conv1: Conv
    norm1: GroupNorm
    conv2: Conv
    norm2: GroupNorm
    conv3: Conv
    norm3: GroupNorm
    out: Conv


class ToneCurves(NamedTuple):
    """Tone curves from well-lit to dark values (`model/tone_curves.py`): logarithms of the rises of R ramps.

    Attributes:
        shared: the curve that all views share.
        offsets: added to `shared` for each training frame.
    """

    shared: Float[Array, "*B R"]
    offsets: Float[Array, "*B F R"]


class SceneParams(NamedTuple):
    """Everything that is learned.

    The last two fields describe the training frames, not the scene.

    Attributes:
        paths: P displacements over time that Gaussians follow, each as K control points of a cubic spline over [0, 1],
            world units; None: no Gaussian has a path.
        exposures: logarithms of the gains of every training frame's colour channels, not used for rendering; None if
            the camera's exposure is taken to be constant.
        curves: how the frames became dark, in scenes whose low-light image is a tone curve of the well-lit one; None
            in the others.
    """

    gaussians: Gaussians
    hexplane: HexPlane
    heads: MotionHeads
    ocd: OCDNet
    bafe: BAFENet
    paths: Float[Array, "*B P K 3"] | None = None
    exposures: Float[Array, "*B F 3"] | None = None
    curves: ToneCurves | None = None


class Scene(NamedTuple):
    """A scene of fixed capacity: rows of `params.gaussians` that are not `alive` are inert.

    Attributes:
        params: learned values.
        alive: which Gaussians exist.
        bounds: lowest and highest corner of the HexPlane's box, world units, not learned.
        extent: the length that learning rates of positions scale with, world units (`ModelConfig.unit`).
        path_of: the row of `params.paths` that each Gaussian of finite lifetime follows, and any other row for the
            others; None if there are no paths.
    """

    params: SceneParams
    alive: Bool[Array, "*B N"]
    bounds: Float[Array, "*B 2 3"]
    extent: Float[Array, "*B"]
    path_of: Int[Array, "*B N"] | None = None


class RasterOutput(NamedTuple):
    """What `rasterize` returns.

    Attributes:
        features: alpha-blended feature channels, no background.
        alpha: accumulated opacity, 1 - final transmittance.
        depth: as `depth_mode` says, world units; 0 where nothing is drawn.
        means2d: projected centres in pixels.
        radii: larger half-width of the bounding box of a Gaussian's visible ellipse, pixels; 0 where it is not drawn.
        pairs: how many (Gaussian, tile) pairs the scene needs.
        overflow: whether `pairs` exceeds the pair buffer; the images are then invalid.
    """

    features: Float[Array, "*B H W C"]
    alpha: Float[Array, "*B H W"]
    depth: Float[Array, "*B H W"]
    means2d: Float[Array, "*B N 2"]
    radii: Float[Array, "*B N"]
    pairs: Int[Array, ""]
    overflow: Bool[Array, ""]


class Decomposition(NamedTuple):
    """Images of the decomposition (Eqs. 5-9), sRGB values in [0, 1] unless said otherwise.

    Attributes:
        welllit: I_w of Eq. 7.
        lowlight: the estimate of I_d, Eq. 9.
        illumination: L_w of Eq. 5, clipped to [0, 1].
        reflectance: R_w of Eq. 6, clipped to [0, 1].
        attenuation: the exponents (B1, B2), each in (1, 10).
    """

    welllit: Float[Array, "*B H W 3"]
    lowlight: Float[Array, "*B H W 3"]
    illumination: Float[Array, "*B H W"]
    reflectance: Float[Array, "*B H W 3"]
    attenuation: Float[Array, "*B H W 2"]


class RenderOutput(NamedTuple):
    """A rendered view: its decomposition, its geometry, and the rasterizer's counters (see `RasterOutput`)."""

    images: Decomposition
    alpha: Float[Array, "*B H W"]
    depth: Float[Array, "*B H W"]
    radii: Float[Array, "*B N"]
    pairs: Int[Array, ""]
    overflow: Bool[Array, ""]
