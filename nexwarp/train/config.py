"""Settings of a training run: dataclasses whose field docstrings say what they are, and the presets."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from nexwarp.checks import check_range
from nexwarp.finish.sh_smoothing import MAX_STRENGTH, MIN_STRENGTH
from nexwarp.kernels.types import MAX_HITS
from nexwarp.render import MAX_JITTER
from nexwarp.train.densify import DensifyConfig
from nexwarp.train.losses import LossWeights

# Schedules are given for runs of this length and stretch with `iterations`.
REFERENCE_ITERATIONS = 30_000
MIN_SURFELS = 16
LARGEST_NUMBER = 2**53  # of settings: all integers up to there are floats too
MASK_MODES = ("ignore", "background")


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates; pairs decay log-linearly over the run."""

    means: tuple[float, float] = (1.6e-4, 1.6e-6)
    """Times the scene scale."""
    quats: float = 1e-3
    """Of the raw quaternions."""
    scales: float = 5e-3
    """Of the logarithms of the scales."""
    opacities: float = 0.025
    """Of the logits of the opacities."""
    gammas: float = 1e-3
    """Of the logarithms of gamma - 1."""
    sh0: float = 2.5e-3
    """Of the plain colours' constant coefficients."""
    shN: float = 1.25e-4
    """Of the other ones."""
    grid: tuple[float, float] = (1e-3, 1e-5)
    """Of the hash grid."""
    mlp: tuple[float, float] = (1e-3, 1e-4)
    """Of the MLP."""

    def __post_init__(self) -> None:
        for rate in dataclasses.fields(self):
            value = getattr(self, rate.name)
            ends = value if isinstance(value, tuple) else (value, value)
            if not (min(ends) > 0 or ends == (0.0, 0.0)):
                raise ValueError(f"{rate.name}: expected rates > 0, or 0 throughout, got {value}")


@dataclass(frozen=True)
class TextureConfig:
    """Shape of the neural texture (paper Sec. 5)."""

    levels: int = 8
    """L, resolution levels."""
    table_size: int | None = None
    """T, entries a level, a power of two; None follows the number of the training photos' pixels."""
    features: int = 4
    """F, features an entry."""
    min_resolution: float | None = None
    """Of the coarsest level, cells per world unit; None derives it from the scene's scale."""
    max_resolution: float | None = None
    """Of the finest level; None derives it from the footprint of the training pixels."""
    width: int = 64
    """Of the hidden layers."""
    hidden_layers: int = 2
    """Number of hidden layers."""
    sh_degree: int | None = None
    """Highest degree of the texture's colours; None is that of the run."""
    residual: bool = True
    """Add the texture's colours to the plain ones instead of replacing them."""
    down_weighting: bool = True
    """Fade levels whose cells are smaller than a pixel (paper Eq. 4)."""


@dataclass(frozen=True)
class Config:
    """Everything that a run depends on, beside the scene."""

    preset: str = "default"
    """Name of the preset that this is, or started from."""
    iterations: int = REFERENCE_ITERATIONS
    """Training steps, one view each; schedules stretch with them."""
    max_surfels: int = 400_000
    """P, the budget: never exceeded. Half of it at most comes from the point cloud."""
    max_hits: int = 2
    """K: ray-surfel hits that are textured in each pixel, 0 to 8; 0 trains without a texture."""
    more_hits_from: int = 25_000
    """Iteration, of a run of 30,000, from which more than 2 hits are textured, where K is more than 2: geometry
    converges with K = 2, which makes fewer floaters."""
    sh_degree: int = 3
    """SH degree of the surfels' and the texture's colours; one more is unlocked every 1,000 iterations."""
    sh_every: int = 1000
    """Iterations, of a run of 30,000, between those."""
    coarse: float = 0.0
    """Fraction of the run, at its start, that trains on photos of half the size: a quarter of the work a step."""
    background: tuple[float, float, float] | None = None
    """Colour behind everything; None takes the scene's, or the mean colour of the training photos."""
    footprints: bool = True
    """Limit the texture's detail in views from closer or farther away than the training views to what those resolved,
    and anti-alias surfels in views from farther away. What no training view textured has no detail."""
    smooth_sh: float = 0.01
    """After training, regularise the surfels' SH towards smoothness, by ridge regression over the training views'
    directions: the strength. Larger costs more in those directions; 0 keeps the SH as trained."""
    exposures: bool = True
    """Estimate each photo's exposure and white balance, as gains of red, green and blue, before training; train at the
    mean exposure; a rendered view gets the gains predicted from nearby photos."""
    metering: bool = True
    """With `exposures`: where the photos' gains follow the brightness of what they show, as automatic exposure makes
    them, predict those of rendered views by that, too."""
    vignetting: bool = True
    """With `exposures`: estimate and take out the lens's vignetting, too."""
    mask_mode: str = "ignore"
    """What a photo's mask leaves out: `ignore` learns nothing there, `background` learns that nothing is there."""
    border: float = 0.08
    """Maximum shift, as a fraction of the frame, of border steps, which render beyond a photo's frame, supervised by
    the photo's repeated edge; 0: no such steps."""
    border_every: int = 4
    """Every how many steps one is a border step."""
    depth_jitter: float = 1.0
    """Random shifts along the ray of the points at which training looks the texture up: standard deviation, in pixels
    at that depth."""
    low_pass: bool = False
    """Screen-space low-pass for surfels smaller than a pixel."""
    clamp_texture: bool = False
    """Limit textured colours to >= 0."""
    clamp_image: bool = False
    """Limit the rendering to [0, 1] before the loss, as the authors' code does."""
    filter_points: bool = True
    """Drop points with short tracks or large reprojection errors before sampling the initial surfels."""
    orient_points: bool = True
    """Lay the initial surfels on planes fitted to the cloud; otherwise their rotations are random."""
    seed: int = 0
    """Random seed."""
    deterministic: bool = False
    """Give the same bits in every run also on CUDA, where sums otherwise depend on the order of threads; slower."""
    cuda_graphs: bool = True
    """On CUDA, repeat steps as CUDA graphs instead of launching each kernel: the same arithmetic, more memory."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Factors of the loss terms."""
    rates: LearningRates = field(default_factory=LearningRates)
    """Learning rates."""
    texture: TextureConfig = field(default_factory=TextureConfig)
    """Shape of the texture."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """Density control."""

    def __post_init__(self) -> None:
        check_range("iterations", self.iterations, 1)
        check_range("max_surfels", self.max_surfels, MIN_SURFELS)
        check_range("max_hits", self.max_hits, 0, MAX_HITS)
        check_range("more_hits_from", self.more_hits_from, 0)
        check_range("sh_degree", self.sh_degree, 0, 3)
        check_range("seed", self.seed, 0, 2**32 - 1)
        check_range("coarse", self.coarse, 0.0, 1.0)
        check_range("border", self.border, 0.0, 0.5)
        check_range("border_every", self.border_every, 1)
        check_range("sh_every", self.sh_every, 1)
        if self.smooth_sh != 0.0:
            check_range("smooth_sh, where it is not 0,", self.smooth_sh, MIN_STRENGTH, MAX_STRENGTH)
        check_range("depth_jitter", self.depth_jitter, 0.0, MAX_JITTER)
        for value in self.background or ():
            check_range("background", value, 0.0, 1.0)
        if self.clamp_texture and self.texture.residual:
            raise ValueError("clamp_texture: expected False with texture.residual, got True")
        if self.mask_mode not in MASK_MODES:
            raise ValueError(f"mask_mode: expected one of {', '.join(MASK_MODES)}, got {self.mask_mode!r}")

    def scaled(self, iteration: float) -> int:
        """Iteration of this run that stands for one of a run of 30,000."""
        return max(1, round(iteration * self.iterations / REFERENCE_ITERATIONS))

    @property
    def settled(self) -> int:
        """First iteration of this run in which a pixel textures more than 2 hits, where K is more."""
        return math.ceil(self.more_hits_from * self.iterations / REFERENCE_ITERATIONS)

    def hits_at(self, iteration: int) -> int:
        """K at an iteration of this run: `max_hits`, but at most 2 while surfels settle."""
        return self.max_hits if iteration >= self.settled else min(self.max_hits, 2)

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain JSON values."""
        return dataclasses.asdict(self)
