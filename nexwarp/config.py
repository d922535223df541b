"""Settings of a training run: dataclasses whose field docstrings say what they are, and the presets."""

import dataclasses
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, get_args, get_origin, get_type_hints

from nexwarp.densify import DensifyConfig
from nexwarp.kernels.types import MAX_HITS
from nexwarp.losses import LossWeights
from nexwarp.ops.checks import check_range
from nexwarp.render import MAX_JITTER
from nexwarp.smooth_sh import MAX_STRENGTH, MIN_STRENGTH

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
    """Shape of the neural texture (paper Sec. 4)."""

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
    """Fade levels whose cells are smaller than a pixel (paper Eq. 2)."""


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

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Config":
        """Rebuild a config from `as_dict`; ValueError names an unknown key.

        What an older version did not write is as in the preset that the run started from.
        """
        try:
            preset = data.get("preset")
            base = PRESETS[preset] if isinstance(preset, str) and preset in PRESETS else cls()
            data = {k: _part(getattr(base, k), v, k) if k in PARTS else v for k, v in data.items()}
            return dataclasses.replace(base, **_checked(cls, _tuples(data), "config"))
        except (TypeError, AttributeError, KindError) as error:
            raise ValueError(f"config: expected the settings of a nexwarp run ({error})") from None


PARTS = ("losses", "rates", "texture", "densify")


def _part(base: Any, data: Any, where: str) -> Any:
    """A part of the settings."""
    return dataclasses.replace(base, **_checked(type(base), _tuples(data), where))


class KindError(ValueError):
    """A setting's value is not of its type."""


def _tuples(data: dict[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}


def _checked(cls: type, data: dict[str, Any], where: str) -> dict[str, Any]:
    """Return settings whose values have their fields' types; numbers are finite."""
    types = get_type_hints(cls)
    for name, value in data.items():
        if name in types and not _fits(value, types[name]):
            kind = getattr(types[name], "__name__", types[name]) if not get_args(types[name]) else types[name]
            raise KindError(f"{where}: {name}: expected {kind}, got {value!r:.60}")
    return data


def _fits(value: Any, kind: Any) -> bool:
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        return isinstance(value, tuple) and len(value) == len(kinds) and all(map(_fits, value, kinds))
    if get_args(kind):  # a union
        return any(_fits(value, one) for one in get_args(kind))
    if isinstance(value, bool) or kind not in (int, float):
        return isinstance(value, kind)
    if not isinstance(value, int if kind is int else (int, float)):
        return False
    return abs(value) <= LARGEST_NUMBER


def with_settings(config: Config, settings: dict[str, Any]) -> Config:
    """Return a config with some settings replaced.

    Args:
        config: what to start from.
        settings: name -> value; a dot leads into a part, as in "texture.residual". Lists stand for tuples.

    Raises:
        ValueError: there is no setting of that name, or its value is of another type or out of range.
    """
    changes: dict[str, dict[str, Any]] = {}
    for name, value in settings.items():
        part, key = _find_setting(config, name)
        hints = get_type_hints(type(getattr(config, part) if part else config))
        changes.setdefault(part, {})[key] = _typed(name, value, hints[key])
    whole = changes.pop("", {})
    for part, values in changes.items():
        try:
            whole[part] = dataclasses.replace(getattr(config, part), **values)
        except ValueError as error:  # which names the setting without the part
            raise ValueError(f"{part}.{error}") from None
    return dataclasses.replace(config, **whole)


def setting(config: Config, name: str) -> Any:
    """Return the value of a setting, named as `with_settings` names it; ValueError when there is none."""
    part, key = _find_setting(config, name)
    return getattr(getattr(config, part) if part else config, key)


def parse_settings(texts: Iterable[str]) -> dict[str, Any]:
    """Read settings as a person types them.

    Args:
        texts: KEY=VALUE each; VALUE is JSON, or else stands for itself as a string.

    Returns:
        What `with_settings` takes; names and types are checked there.

    Raises:
        ValueError: no KEY=VALUE, or a KEY twice.
    """
    settings: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (x.strip() for x in text.partition("="))
        if not (name and equals and value):
            raise ValueError(f"expected KEY=VALUE, got {text!r}")
        if name in settings:
            raise ValueError(f"{name}: expected it once, got it twice")
        try:
            settings[name] = json.loads(value)
        except (ValueError, RecursionError):
            settings[name] = value
    return settings


def _find_setting(config: Config, name: str) -> tuple[str, str]:
    """Part, or "", and key of a setting."""
    part, _, key = name.rpartition(".")
    parts = {f.name for f in dataclasses.fields(config) if dataclasses.is_dataclass(getattr(config, f.name))}
    known = [f.name for f in dataclasses.fields(config) if f.name not in parts]
    known += [f"{p}.{f.name}" for p in sorted(parts) for f in dataclasses.fields(getattr(config, p))]
    if name in known:
        return part, key
    close = get_close_matches(name, known, n=4, cutoff=0.5) or [n for n in known if n.startswith(f"{part or name}.")]
    # Not the first one of all, the preset, which has a flag of its own.
    raise ValueError(f"{name}: expected a setting, such as {', '.join(close or known[1:5])}")


def _typed(name: str, value: Any, annotation: Any) -> Any:
    """Return a value as its annotation has it: int where float is meant and list for tuple will do."""
    options = [annotation] if annotation in (int, float, bool, str) else _alternatives(annotation)
    for option in options:
        if option is float and type(value) in (int, float) and abs(value) <= LARGEST_NUMBER:
            return float(value)
        if option is int and type(value) is int and abs(value) <= LARGEST_NUMBER:
            return value
        if option in (bool, str, type(None)) and type(value) is option:
            return value
        if get_origin(option) is tuple and isinstance(value, (list, tuple)) and len(value) == len(get_args(option)):
            return tuple(_typed(name, x, kind) for x, kind in zip(value, get_args(option), strict=True))
    expected = " or ".join(_described(option) for option in options)
    raise ValueError(f"{name}: expected {expected}, got {json.dumps(value, default=repr)[:60]}")


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """Members of a union; anything else alone."""
    return (annotation,) if get_origin(annotation) is tuple else get_args(annotation)


def _described(kind: Any) -> str:
    if get_origin(kind) is tuple:
        return f"a list of {len(get_args(kind))} numbers"
    names = {int: "an integer", float: "a number", bool: "true or false", str: "text", type(None): "null"}
    return names[kind]


PRESETS: dict[str, Config] = {
    "default": Config(),
    "paper": Config(
        preset="paper",
        more_hits_from=0,
        background=(0.0, 0.0, 0.0),
        border=0.0,
        depth_jitter=0.0,
        footprints=False,
        smooth_sh=0.0,
        exposures=False,
        metering=False,
        vignetting=False,
        clamp_image=True,
        filter_points=False,
        orient_points=False,
        rates=LearningRates(mlp=(1e-3, 1e-3)),
        texture=TextureConfig(
            levels=16, table_size=2**20, features=2, min_resolution=16.0, max_resolution=256.0, residual=False
        ),
        losses=LossWeights(depth=0.0, alpha_hits=MAX_HITS),
        densify=DensifyConfig(prune_at_cap=False, floaters=False),
    ),
}


def preset(name: str) -> Config:
    """Return a preset; ValueError lists the known ones."""
    if name not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(sorted(PRESETS))}, got {name!r}")
    return PRESETS[name]
