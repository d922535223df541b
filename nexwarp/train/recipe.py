"""The recipe: every setting of a training and its default, and the presets.

What a person chooses, `USER_SETTINGS`, is shown by `nexwarp train --help` and docs/options.md. All other settings are
documented here alone; `--set KEY=VALUE` and `nexwarp.Config` reach them, too. Iterations are those of a run of 30,000;
schedules stretch with `Config.iterations`.
"""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from nexwarp.errors import check_range
from nexwarp.io.files import one_line
from nexwarp.io.json_files import Json
from nexwarp.kernels.types import MAX_HITS, MAX_SH_DEGREE
from nexwarp.model.render import MAX_JITTER
from nexwarp.model.texture import check_sizes
from nexwarp.ops.tiles import check_order

REFERENCE_ITERATIONS = 30_000
NORMALS_FROM = 7_000  # iteration, of a run of 30,000, from which the normal loss counts: that of 2DGS
SHARPENING = (0.3, 0.8)  # shares of a run between which the least gamma rises from 1
FEW_PHOTOS = 44  # training photos up to which a scene has few
MIN_SURFELS = 16
MASK_MODES = ("ignore", "background")
MOST_TEACHERS = 8
MIN_STRENGTH, MAX_STRENGTH = 1e-6, 1e6  # of SH smoothing; 0 is allowed too, less is lost in the harmonics' rounding

LARGEST_NUMBER = 2**53  # all integers up to there are floats too
KINDS: dict[object, str] = {
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "text",
    type(None): "null",
}


def typed(name: str, value: object, annotation: object) -> object:
    """Return a value as its annotation has it, int where float is meant and list for tuple will do; or ValueError."""
    options = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    number = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LARGEST_NUMBER
    for option in options:
        if get_origin(option) is tuple:
            kinds = get_args(option)
            if isinstance(value, (list, tuple)) and len(value) == len(kinds):
                return tuple(typed(name, x, kind) for x, kind in zip(value, kinds, strict=True))
        elif option in (int, float):
            if number and (option is float or isinstance(value, int)):
                return option(value)
        elif type(value) is option:
            return value
    names = (getattr(x, "__name__", "") if dataclasses.is_dataclass(x) else KINDS.get(x) for x in options)
    lengths = (f"a list of {len(get_args(x))} numbers" for x in options)
    expected = " or ".join(name or length for name, length in zip(names, lengths, strict=True))
    raise ValueError(f"{name}: expected {expected}, got {json.dumps(value, default=repr)[:60]}")


def within(default: float | None, low: float, high: float = math.inf) -> Any:
    """Return a setting's field: a number from low to high, or several, or None."""
    return field(default=default, metadata={"range": (low, high)})


class Settings:
    """Base of the dataclasses of settings; ValueError names a field of another type, or out of its range."""

    def __post_init__(self) -> None:
        annotations = get_type_hints(type(self))
        for entry in dataclasses.fields(self):  # type: ignore[arg-type]  # of its subclasses
            value = typed(entry.name, getattr(self, entry.name), annotations[entry.name])
            object.__setattr__(self, entry.name, value)
            if "range" in entry.metadata and value is not None:
                for number in value if isinstance(value, tuple) else (value,):
                    check_range(entry.name, number, *entry.metadata["range"])


@dataclass(frozen=True)
class LossWeights(Settings):
    """Factors of the terms of the training loss; a term with factor 0 is not computed."""

    dssim: float = within(0.2, 0.0, 1.0)
    """Share of D-SSIM in the image loss; L1 has the rest."""
    alpha: float = within(0.005, 0.0)
    """Factor of the penalty on blending weight that the two heaviest hits of a pixel do not have."""
    texture: float = within(0.5, 0.0)
    """Factor of the L1 distance between the un-premultiplied textured colours and the photo."""
    opacity: float = within(0.01, 0.0)
    """Factor of the surfels' mean opacity; makes them sparse."""
    binary: float = within(0.0, 0.0)
    """Factor of the surfels' mean of opacity (1 - opacity); makes them opaque, or removes them."""
    grid: float = within(0.01, 0.0)
    """Factor of the hash grid's squared values, each level divided by its resolution cubed."""
    empty: float = within(0.1, 0.0)
    """Factor of the opacity in pixels that a mask declares as background."""
    depth: float = within(0.3, 0.0)
    """Factor of the relative depth error at the points that were triangulated from the photo."""
    depth_maps: float = within(1.0, 0.0)
    """Factor of the relative depth error where photos have depth maps."""
    normals: float = within(0.0, 0.0)
    """Factor of the normal consistency of 2DGS: the difference between the surfels' normals and those of the depth map.
    Counts from 7/30 of the run on; smoother meshes."""


Rate = float | tuple[float, float]  # throughout a run, or first and last


@dataclass(frozen=True)
class LearningRates(Settings):
    """Adam's learning rates: one throughout the run, or the first and the last of a log-linear decay."""

    means: Rate = (1.6e-4, 1.6e-6)
    """Learning rates of the centres, times the scene scale."""
    quats: Rate = 1e-3
    """Learning rate of the raw quaternions."""
    scales: Rate = (2e-2, 1e-3)
    """Learning rates of the logarithms of the scales."""
    opacities: Rate = 0.025
    """Learning rate of the logits of the opacities."""
    gammas: Rate = 1e-3
    """Learning rate of the logarithms of gamma - 1."""
    sh0: Rate = 2.5e-3
    """Learning rate of the plain colours' constant SH coefficients."""
    shN: Rate = (6.25e-4, 6.25e-5)
    """Learning rates of the plain colours' other SH coefficients."""
    grid: Rate = (1e-3, 1e-5)
    """Learning rates of the hash grid."""
    mlp: Rate = 1e-3
    """Learning rate of the MLP."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for rate in dataclasses.fields(self):
            value = getattr(self, rate.name)
            ends = value if isinstance(value, tuple) else (value, value)
            if not (min(ends) > 0 or ends == (0.0, 0.0)):
                raise ValueError(f"{rate.name}: expected rates > 0, or 0 throughout, got {value}")
            if ends[0] == ends[1]:
                object.__setattr__(self, rate.name, ends[0])


@dataclass(frozen=True)
class TextureConfig(Settings):
    """Shape of the neural texture (paper Sec. 5)."""

    levels: int = 8
    """L, number of resolution levels."""
    table_size: int | None = None
    """T, entries per level, a power of two; None derives it from the training photos: a tenth of a number for each
    pixel. More than 44 photos raise it up to four times, but not beyond 2^19. More entries make sharper pictures, of a
    lower LPIPS, and larger files."""
    features: int = 4
    """F, features per entry."""
    min_resolution: float | None = None
    """Resolution of the coarsest level, cells per world unit; None derives it from the scene scale."""
    max_resolution: float | None = None
    """Resolution of the finest level, cells per world unit; None makes its cells as large as the training pixels are at
    the points that they see."""
    width: int = 64
    """Width of the hidden layers of the MLP."""
    hidden_layers: int = 2
    """Number of hidden layers of the MLP."""
    sh_degree: int | None = None
    """SH degree of the texture's colours, 0 to 3; None takes that of the run."""
    residual: bool = True
    """Add the texture's colours to the plain ones instead of replacing them."""
    down_weighting: bool = True
    """Fade levels whose cells are smaller than a pixel (paper Eq. 4)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        entries = 1 if self.table_size is None else self.table_size
        degree = 0 if self.sh_degree is None else self.sh_degree
        check_sizes(self.levels, entries, self.features, self.width, self.hidden_layers, degree)


@dataclass(frozen=True)
class DensifyConfig(Settings):
    """When and how surfels are split and pruned; iterations are those of a run of 30,000."""

    start: int = 500
    """Iteration of the first round (exclusive)."""
    stop: int = 25_000
    """Iteration of the last round (exclusive)."""
    every: int = within(100, 1)
    """Iterations between rounds."""
    fraction: float = within(0.05, 0.0, 1.0)
    """Fraction of the surfels that a round splits, within the budget."""
    prune_opacity: float = within(0.005, 0.0, 1.0)
    """Surfels with less opacity than this are removed."""
    prune_at_cap: bool = True
    """Prune also once the budget is used up, and split others in their place (the authors' code does neither)."""
    relocate: float = within(0.1, 0.0, 0.5)
    """Fraction of the surfels that every tenth round removes once the budget is used up, until iteration 15,000: those
    that contribute least to the training views. Others are split in their place. 0 removes none."""


@dataclass(frozen=True)
class Recipe(Settings):
    """How a training goes about it: what few people change."""

    steps_a_photo: int | None = within(None, 1)
    """Training steps for each training photo at most: shortens `iterations` where photos are few, to 7,000 at least."""
    more_hits_from: int = within(25_000, 0)
    """With K > 2: the iteration, of a run of 30,000, from which more than 2 hits are textured. Geometry that converges
    with K = 2 has fewer floaters."""
    sh_every: int = within(1000, 1)
    """Iterations, of a run of 30,000, after which the SH degree rises by one."""
    depth_jitter: float = within(1.0, 0.0, MAX_JITTER)
    """Standard deviation, in pixels at the hit's depth, of random shifts along the ray of the points at which training
    evaluates the texture."""
    least_gamma: float = within(1.5, 1.0)
    """Least gamma of surfels at the end. The bound rises from 1 between 0.3 and 0.8 of the run; sharper surfels overlap
    less, so frames and steps are faster."""
    filter_points: bool = True
    """Drop points with short tracks or large reprojection errors before sampling the initial surfels."""
    orient_points: bool = True
    """Orient the initial surfels along planes fitted to the point cloud; otherwise their rotations are random."""
    skybox: int = within(100, 0)
    """Number of points on a sphere around the scene, for backgrounds without points of the cloud, such as the room
    behind a table. Initial surfels start on those around which photos show no point of the cloud. They are at most a
    sixth of the initial surfels. Where photos are transparent there are none."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Factors of the loss terms."""
    rates: LearningRates = field(default_factory=LearningRates)
    """Learning rates."""
    texture: TextureConfig = field(default_factory=TextureConfig)
    """Shape of the texture."""
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    """Density control."""


@dataclass(frozen=True)
class Config(Recipe):
    """All settings of a training run; run and scene together determine the result."""

    preset: str = "default"
    """Name of the preset from which the settings started."""
    iterations: int = within(REFERENCE_ITERATIONS, 1)
    """Number of training steps; each renders one view. All schedules stretch with this number."""
    max_surfels: int = within(400_000, MIN_SURFELS)
    """P, the largest number of surfels. At most half as many start from the point cloud."""
    max_hits: int = within(2, 0, MAX_HITS)
    """K, the number of ray-surfel hits that are textured in each pixel, 0 to 8; 0 trains without a texture."""
    sh_degree: int = within(3, 0, MAX_SH_DEGREE)
    """SH degree of the surfels' colours, 0 to 3, and of the texture's. Training starts at degree 0."""
    background: tuple[float, float, float] | None = within(None, 0.0, 1.0)
    """Background colour; None takes that of the scene, or the mean colour of the training photos."""
    mask_mode: str = "ignore"
    """How masked pixels are trained: `ignore` leaves them out of the loss, `background` trains them to show the
    background."""
    exposures: bool = True
    """Estimate each photo's exposure and white balance, as gains of red, green and blue, and the vignetting of the lens
    before training, and train at the mean exposure. Rendered views get gains that are predicted from nearby photos.
    Each is left out where the photos do not show it."""
    footprints: bool = True
    """Detail limits: in views from closer or farther away than the training views, limit the texture's detail to what
    the training views resolved; in views from farther away, also anti-alias the surfels."""
    smooth_sh: float = 0.01
    """Strength of SH smoothing, a ridge regression after training that makes a surfel's colour smooth in directions
    that no training view has. A larger strength changes the colours in the training views more; 0 keeps the SH as
    trained."""
    refine_poses: bool = False
    """Learn a small rigid correction of each training camera, for poses that are not exact. Test poses stay as given;
    `nexwarp eval --refine-poses` fits them, too."""
    teachers: int | None = within(None, 0, MOST_TEACHERS)
    """Number of teachers: models of other seeds that are trained first, in two fifths of the iterations, and from whose
    renderings the run then learns, too, for captures of few photos (docs/sparse.md). Each has four times `max_surfels`
    but at most 40,000, and never fewer than `max_surfels`. None is 2 where there are at most 44 training photos, at
    least 300 surfels of `max_surfels` for each of them and at least 30,000 iterations, and where poses stay as given;
    otherwise 0."""
    order: str = "depth"
    """Order in which surfels are blended, in training and in the model: `depth` is by their centres' z-depth,
    `distance` by their distance from the camera, for scenes that are shown as panoramas."""
    seed: int = within(0, 0, 2**32 - 1)
    """Random seed."""
    deterministic: bool = False
    """Give the same bits in every run also on CUDA, where sums otherwise depend on the order of threads; slower."""
    cuda_graphs: bool = True
    """On CUDA, repeat steps as CUDA graphs instead of launching each kernel: the same arithmetic, more memory."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.smooth_sh != 0.0:
            check_range("smooth_sh, where it is not 0,", self.smooth_sh, MIN_STRENGTH, MAX_STRENGTH)
        check_order(self.order)
        if self.teachers and self.refine_poses:
            raise ValueError(f"teachers: expected 0 or null where poses are learned, got {self.teachers}")
        if self.mask_mode not in MASK_MODES:
            raise ValueError(f"mask_mode: expected one of {', '.join(MASK_MODES)}, got {self.mask_mode!r}")

    def scaled(self, iteration: float) -> int:
        """Iteration of this run that stands for one of a run of 30,000."""
        return max(1, round(iteration * self.iterations / REFERENCE_ITERATIONS))

    def hits_at(self, iteration: int) -> int:
        """K at an iteration of this run: `max_hits`, but at most 2 while surfels settle."""
        settled = math.ceil(self.more_hits_from * self.iterations / REFERENCE_ITERATIONS)
        return self.max_hits if iteration >= settled else min(self.max_hits, 2)

    def normals_at(self, iteration: int) -> float:
        """Factor of the normal loss at an iteration of this run: 0 in its first 7/30."""
        return self.losses.normals if iteration / self.iterations >= NORMALS_FROM / REFERENCE_ITERATIONS else 0.0

    def least_gamma_at(self, iteration: int) -> float:
        """Least gamma at an iteration of this run: 1 until the first share of `SHARPENING`."""
        first, last = SHARPENING
        risen = (iteration / self.iterations - first) / (last - first)
        return 1 + (self.least_gamma - 1) * min(max(risen, 0.0), 1.0)

    def as_dict(self) -> dict[str, Any]:
        """Return the settings as plain JSON values."""
        return dataclasses.asdict(self)


# What a person chooses; `Recipe` has the rest.
USER_SETTINGS = (*Config.__annotations__, "losses.depth", "losses.normals", "texture.table_size")

DEFAULT = Config()

# Captures of up to 130 photos in less time.
FAST = Config(preset="fast", steps_a_photo=230, teachers=0)

# A texture that weak GPUs evaluate in real time: a third of the arithmetic.
WEB = Config(preset="web", texture=TextureConfig(width=32, hidden_layers=1, sh_degree=1))

# The publication's; what it does not have is off.
PAPER = Config(
    preset="paper",
    more_hits_from=0,
    background=(0.0, 0.0, 0.0),
    depth_jitter=0.0,
    least_gamma=1.0,
    footprints=False,
    smooth_sh=0.0,
    exposures=False,
    filter_points=False,
    orient_points=False,
    skybox=0,
    teachers=0,
    texture=TextureConfig(
        levels=16, table_size=2**20, features=2, min_resolution=16.0, max_resolution=256.0, residual=False
    ),
    losses=LossWeights(depth=0.0, depth_maps=0.0),
    rates=LearningRates(scales=5e-3, shN=1.25e-4),
    densify=DensifyConfig(prune_at_cap=False, relocate=0.0),
)

# What the demo changes in any preset: it is small enough for two CPU cores, a short run, so its steps are larger.
DEMO_SETTINGS: dict[str, object] = {
    "iterations": 700,
    "max_surfels": 3000,
    "depth_jitter": 0.5,
    "texture.levels": 12,
    "texture.table_size": 2**15,
    "texture.features": 2,
    "texture.width": 32,
    "rates.means": (5e-4, 5e-6),
    "rates.quats": 5e-3,
    "rates.scales": 2.5e-2,
    "rates.opacities": 0.05,
    "rates.gammas": 5e-3,
    "rates.sh0": 1.25e-2,
    "rates.shN": 6e-4,
    "rates.grid": (2e-2, 2e-4),
    "rates.mlp": (3e-3, 3e-4),
}

PRESETS = {config.preset: config for config in (DEFAULT, FAST, WEB, PAPER)}


def preset(name: str) -> Config:
    """Return a preset; ValueError lists the known ones."""
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(sorted(PRESETS))}, got {name!r}")
    return PRESETS[name]


# Settings by name: as a person types them, and as a run's config.json holds them.
PARTS = [field.name for field in dataclasses.fields(Config) if dataclasses.is_dataclass(getattr(DEFAULT, field.name))]
Stored = Mapping[str, Any]  # settings, as `Config.as_dict` of any version returns them
# What runs did before a setting existed, where the default does something else.
BEFORE: dict[str, object] = {"skybox": 0, "teachers": 0, "densify.relocate": 0.0, "least_gamma": 1.0}
# Settings that no version has any more, and the value with which they did nothing.
REMOVED: dict[str, object] = {"blur_poses": 1, "coarse": 0.0, "low_pass": False, "losses.distortion": 0.0}


def setting_names() -> list[str]:
    """Return the names of all settings; a dot leads into a part, as in "texture.residual"."""
    return list(_flat(DEFAULT.as_dict()))


def setting(config: Config, name: str) -> object:
    """Return the value of a setting; ValueError when there is none of that name."""
    _check_name(name)
    part, _, key = name.rpartition(".")
    return getattr(getattr(config, part) if part else config, key)


def with_settings(config: Config, settings: Mapping[str, object]) -> Config:
    """Return a config with some settings replaced, by name; lists stand for tuples.

    Raises:
        ValueError: there is no setting of that name, or its value is of another type or out of range.
    """
    changes: dict[str, dict[str, object]] = {}
    for name, value in settings.items():
        _check_name(name)
        part, _, key = name.rpartition(".")
        changes.setdefault(part, {})[key] = value
    whole = changes.pop("", {})
    for part, values in changes.items():
        try:
            whole[part] = dataclasses.replace(getattr(config, part), **values)
        except ValueError as error:  # which names the setting without the part
            raise ValueError(f"{part}.{error}") from None
    return dataclasses.replace(config, **whole)  # type: ignore[arg-type]  # it checks them


def parse_settings(texts: Iterable[str]) -> dict[str, Json]:
    """Read settings as a person types them, KEY=VALUE each; VALUE is JSON, or else stands for itself as a string.

    Raises:
        ValueError: no KEY=VALUE, or a KEY twice; names and types are checked in `with_settings`.
    """
    settings: dict[str, Json] = {}
    for text in texts:
        name, equals, value = (x.strip() for x in text.partition("="))
        if not (name and equals and value):
            raise ValueError(f"expected KEY=VALUE, got {text!r:.60}")
        if name in settings:
            raise ValueError(f"{one_line(name, 60)}: expected it once, got it twice")
        try:
            settings[name] = json.loads(value)
        except (ValueError, RecursionError):
            settings[name] = value
    return settings


def config_from_dict(data: Stored) -> Config:
    """Rebuild a config from `Config.as_dict`; ValueError names a value of another type or out of range.

    Settings that an older version did not write are those of the preset that the run started from, but for those of
    `BEFORE`. Those that this version does not know are passed over; see `refuse_removed`.
    """
    try:
        stored = _flat(data)
        if "densify" in data:  # the record of a run has it, a few settings do not
            stored = BEFORE | stored
        known = {name: stored[name] for name in setting_names() if name in stored}
        return with_settings(PRESETS.get(data.get("preset", ""), DEFAULT), known)
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"config: expected the settings of a nexwarp run ({error})") from None


def refuse_removed(data: Stored) -> None:
    """Raise ValueError where settings, as an older version wrote them, ask for something that was removed since."""
    stored = _flat(data)
    for name, neutral in REMOVED.items():
        if stored.get(name, neutral) != neutral:
            raise ValueError(f"{name}: {stored[name]} was removed; versions up to 0.2 have it")


def _flat(data: Stored) -> dict[str, object]:
    """Return the settings of `Config.as_dict`, or of another version, by name."""
    flat: dict[str, object] = {}
    for name, value in data.items():
        if name in PARTS:
            flat |= {f"{name}.{key}": x for key, x in value.items()}
        else:
            flat[name] = value
    return flat


def _check_name(name: str) -> None:
    if name in REMOVED:
        raise ValueError(f"{name}: expected a setting, got one that was removed; versions up to 0.2 have it")
    known = setting_names()
    if name not in known:
        close = get_close_matches(name, known, n=4, cutoff=0.5) or known[:4]
        raise ValueError(f"{one_line(name, 60)}: expected a setting, such as {', '.join(close)}")
