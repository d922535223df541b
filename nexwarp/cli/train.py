"""`nexwarp train`."""

import dataclasses
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.device import joined_ranks
from nexwarp.cli.display import device_name
from nexwarp.cli.options import Device_, Host_, Port_, Preset_, Scene_, check_max_hits, option, with_flag_settings
from nexwarp.cli.process import SCENES, is_video, scene_of_video
from nexwarp.cli.staged_session import StagedSession, extend_run
from nexwarp.cli.view import print_url, show_until_interrupted
from nexwarp.data import Scene
from nexwarp.errors import SettingError
from nexwarp.io.json_files import Json
from nexwarp.model.model_file import load
from nexwarp.run.folder import (
    DEMO,
    SceneSource,
    began,
    check_teachers_place,
    claimed_run,
    create_run,
    keep_camera_path,
    prepare_run,
    read_own_teachers,
    read_run,
    read_teachers,
    record_places,
)
from nexwarp.run.log_sinks import PACKAGES, check_package
from nexwarp.train.ranks.join import is_rank
from nexwarp.train.ranks.launch import check_count
from nexwarp.train.ranks.ranks import Ranks
from nexwarp.train.ranks.shared import shared_scene
from nexwarp.train.recipe import DEMO_SETTINGS, Config, preset
from nexwarp.train.settings import config_from_dict, parse_settings, setting, with_settings
from nexwarp.train.stages import NO_TEACHERS, OwnTeachers, plan_teachers

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer


@dataclass
class Train:
    """Train a scene, evaluate it on its test views, and write everything to a run folder."""

    scene: Scene_
    """Folder of a COLMAP, nerfstudio or Blender scene, `demo` for the built-in one (docs/scenes.md), or a video, which
    first becomes the scene scenes/NAME as with the command `process`."""
    run: Annotated[Path | None, option("RUN", "runs/SCENE")] = None
    """Run folder to write."""
    max_surfels: Annotated[int | None, option("P", "400000; demo 3000")] = None
    """Largest number of surfels."""
    iterations: Annotated[int | None, option("N", "30000; demo 1200")] = None
    """Views to train on, one a step on one GPU; schedules scale with it."""
    downscale: Annotated[int, option("N")] = 1
    """Factor by which photos are downscaled, with an area filter."""
    images: Annotated[str, option("FOLDER")] = "images"
    """Folder of the photos, relative to SCENE, such as images_4."""
    masks: Annotated[str, option("{FOLDER,alpha,none}")] = "masks"
    """Folder of the masks, relative to SCENE, used if it exists; `alpha` takes the photos' alpha channel as masks."""
    mask_mode: Annotated[str | None, option("{ignore,background}", "ignore")] = None
    """Treatment of masked-out pixels: `ignore` excludes them from training, `background` trains them to be empty."""
    background: Annotated[
        str | None, option("{white,black,R,G,B,random}", "white for Blender scenes, else alpha is ignored")
    ] = None
    """Colour behind transparent photos and behind renderings; R,G,B are in [0, 1], `random` changes in each step."""
    points: Annotated[str | None, option("FILE.ply", "the scene's own points")] = None
    """PLY file of the initial points."""
    format: Annotated[str | None, option("{colmap,nerfstudio,blender}", "detected")] = None
    """Format of the scene, for a folder that holds several."""
    follow_links: bool = False
    """Allow photos that symbolic links lead to outside of SCENE, as with DVC, git-annex and caches of hubs."""
    skip_missing: bool = False
    """Train without photos that do not exist; they are named."""
    max_hits: Annotated[int | None, option("K", "2")] = None
    """K: number of ray-surfel hits textured in each pixel, 0 to 8; 0 trains without a texture."""
    refine_poses: bool = False
    """Learn a small correction of each training pose, for poses that are not exact (docs/poses.md)."""
    teachers: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(name="teacher", metavar="RUN", help_behavior_hint="(repeatable)"),
    ] = ()
    """Also learn from the renderings of a finished run of the scene, for few photos (docs/sparse.md)."""
    preset: Preset_ = "default"
    """Settings to start from: nexwarp's defaults, those of the paper (docs/paper.md), or `web`, defaults with a smaller
    texture network for web pages on weak GPUs (docs/web.md)."""
    settings: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(name="set", metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
    ] = ()
    """Change any setting of docs/options.md, such as texture.max_resolution=1024; VALUE is JSON or a bare word."""
    seed: Annotated[int | None, option("N", "0")] = None
    """Random seed."""
    deterministic: bool = False
    """Make CUDA runs bitwise reproducible, which is slower; CPU runs always are."""
    device: Device_ = None
    """Device to train on."""
    gpus: Annotated[int | None, option("N", "1")] = None
    """Number of GPUs of this machine to train on, each in a process of its own; with --device cpu, of processes.
    `torchrun` starts the same on several machines (docs/gpus.md)."""
    resume: bool = False
    """Continue the run in --run with its settings; other options must agree with them. Only --iterations may be larger:
    schedules are then those of the longer run (docs/resume.md)."""
    checkpoint_every: Annotated[int | None, option("N", "a tenth of the run")] = None
    """Iterations between checkpoints; the last two are kept."""
    overwrite: bool = False
    """Replace the run in --run; files that nexwarp did not write stay."""
    view: bool = False
    """Show the training in the browser, then the result until Ctrl-C (extra `viewer`)."""
    host: Host_ = "127.0.0.1"
    """Address that --view listens on; 0.0.0.0 allows other machines, with the token of the URL that is printed."""
    port: Port_ = 8080
    """Port of --view; 0 picks a free one."""
    tensorboard: bool = False
    """Also log to RUN/tensorboard, for `tensorboard --logdir runs` (extra `tensorboard`)."""
    wandb: bool = False
    """Also log to Weights & Biases, by the same names (extra `wandb`); WANDB_MODE=offline needs no account."""

    def __call__(self, console: Console) -> None:
        """Train."""
        with joined_ranks(self.device, self.gpus) as ranks:
            self._train(ranks, console if ranks.first else Console(quiet=True))

    def starts(self) -> int:
        """Return how many processes this command is to start; 0 if it trains in this one."""
        if is_rank() or self.gpus in (None, 1):
            return 0
        assert self.gpus is not None
        check_count(self.gpus, self.device)
        return self.gpus

    def _train(self, ranks: Ranks, console: Console) -> None:
        if is_video(self.scene):
            # Rank 0 makes the scene; the others find it.
            made = str(self._scene_of_video(ranks, console)) if ranks.first else None
            self.scene = str(ranks.share(made)) if ranks.size > 1 else str(made)
        run = self.run or Path("runs") / self._source().name
        with ExitStack() as claim:
            source, config, resume, own = self._plan(run, ranks, claim, console)
            given = [load(path) for path in self.teachers]  # a wrong path is told before photos are read
            scene = self._load_scene(source, config, ranks, console)
            config = self._with_background(config, scene, resume)
            if own is None:
                own = NO_TEACHERS if given else plan_teachers(config, len(scene.train))
            session = StagedSession(
                scene,
                config,
                own,
                run,
                source,
                console,
                ranks,
                teachers=given,
                resume=resume,
                sinks=self._sinks(),
                every=self.checkpoint_every,
            )
            session.begin()
            if ranks.first:
                if resume:
                    extend_run(run, config, console)
                    record_places(run, source, self.teachers)
                else:
                    check_teachers_place(run, own.count)
            if self.resume and not resume:
                console.print(f"{run}: no checkpoint yet, training starts from the beginning", soft_wrap=True)
            with self._viewer(session, config, run, source.name, console) as viewer:
                if not resume and ranks.first:
                    names = create_run(run, source, config, ranks.device.type, ranks.launch, self.teachers, own)
                    _tell_foreign(console, run, names)
                session.train(viewer)
                model = session.finish()
                claim.close()  # while the viewer shows the result, other commands may write to the run
                ranks.close()
                if viewer is not None:
                    viewer.finish(f"{config.iterations:,} iterations done", lambda: model)
                    show_until_interrupted(viewer, console)

    def _folder_flags(self, run: Path, ranks: Ranks) -> dict[str, bool]:
        """Whether to resume or to overwrite; ranks that torchrun has restarted go on with the run that they began."""
        again = ranks.restarted and began(run, ranks.launch)
        return {"resume": self.resume or again, "overwrite": self.overwrite and not again}

    def _plan(
        self, run: Path, ranks: Ranks, claim: ExitStack, console: Console
    ) -> tuple[SceneSource, Config, bool, OwnTeachers | None]:
        """Claim the run folder, on rank 0.

        Returns:
            The scene, the settings, whether to resume, and the own teachers of a run to resume, the same on all ranks.
        """
        source, config, resume, own = self._source(), None, False, None
        if ranks.first:
            flags = self._folder_flags(run, ranks)
            resume = claim.enter_context(claimed_run(run, source, **flags, warn=partial(display.warn, console)))
            if resume:
                source = self._resumed_source(source, run)
                own = read_own_teachers(run)
                if self.teachers and own.count:
                    given = self.teachers[0]
                    raise SettingError(f"--teacher: expected none, as the run to resume trains its own, got {given}")
                self.teachers = self.teachers or read_teachers(run)
            config = self._config(run, resume)
            self._check()
        if ranks.size > 1:
            mine = None
            if config is not None:
                paths = [str(path) for path in self.teachers]
                mine = [dataclasses.asdict(source), config.as_dict(), resume, paths, own and dataclasses.astuple(own)]
            told = ranks.share(mine)
            assert isinstance(told, list)
            source, config = SceneSource(**(told[0] | {"path": source.path})), config_from_dict(told[1])
            resume, self.teachers = told[2], tuple(map(Path, told[3]))
            own = None if told[4] is None else OwnTeachers(*told[4])
        assert config is not None
        return source, config, resume, own

    def _load_scene(self, source: SceneSource, config: Config, ranks: Ranks, console: Console) -> Scene:
        """Load the scene, and say what it holds."""
        device, count = ranks.device, f", {ranks.size} ranks" if ranks.size > 1 else ""
        console.print(f"{source.name} on {device_name(device)}{count}, preset {config.preset}")
        with display.loading(console) as progress:
            scene = shared_scene(lambda: source.load(progress), ranks)
        size = scene.train[0].camera
        console.print(
            f"{len(scene.train)} training and {len(scene.test)} test views of {size.width}x{size.height}, "
            f"{len(scene.points):,} points"
        )
        return scene

    def _sinks(self) -> list[str]:
        """Return where to log beside the run's file."""
        return [name for name in PACKAGES if getattr(self, name)]

    def _check(self) -> None:
        """Raise SettingError for invalid options, before the photos are read."""
        if self.checkpoint_every is not None and self.checkpoint_every < 1:
            raise SettingError(f"--checkpoint-every: expected at least 1, got {self.checkpoint_every}")
        if self.downscale < 1:
            raise SettingError(f"--downscale: expected at least 1, got {self.downscale}")
        for name in self._sinks():
            check_package(name)
        if self.view:
            from nexwarp.viewer import check_server

            check_server(self.host, self.port)

    def _with_background(self, config: Config, scene: Scene, resume: bool) -> Config:
        """Return a config with the background of the scene's photos; a resumed run keeps its own."""
        if scene.background is None or resume:
            return config
        if "background" in parse_settings(self.settings):
            raise SettingError("--set: background: expected --background instead, which also applies to the photos")
        return dataclasses.replace(config, background=scene.background)

    def _viewer(
        self, session: StagedSession, config: Config, run: Path, title: str, console: Console
    ) -> AbstractContextManager["Viewer | None"]:
        """Return a context with the viewer of the training; with None, without --view."""
        scene = session.trainer.scene
        if not self.view or not session.ranks.first:
            return nullcontext()
        from nexwarp.viewer import Viewer, ViewerOptions

        sets = {"train": scene.train, "test": scene.test}
        viewer = Viewer(
            lambda: session.trainer.model(),
            {group: {view.name: view.camera for view in views} for group, views in sets.items()},
            ViewerOptions(scene.train[0].camera.near, title, self.host, self.port, config.iterations),
            photos={f"{group}/{v.name}": partial(getattr, v, "image") for group, views in sets.items() for v in views},
            save_path=partial(keep_camera_path, run),
        )
        print_url(viewer, console)
        return viewer

    def _scene_of_video(self, ranks: Ranks, console: Console) -> Path:
        """Return the scene of a video; what would stop the training later stops it before the scene is made."""
        video = Path(self.scene)
        self._check()
        for path in self.teachers:
            load(path)
        run, scene = self.run or Path("runs") / video.stem, SceneSource(str(SCENES / video.stem))
        self._config(run, prepare_run(run, scene, **self._folder_flags(run, ranks)))
        return scene_of_video(video, console)

    def _source(self) -> SceneSource:
        """Return the scene of the options."""
        return SceneSource(
            self.scene,
            self.images,
            self.downscale,
            self.masks,
            self.background,
            self.points,
            self.format,
            self.follow_links,
            self.skip_missing,
        )

    def _resumed_source(self, source: SceneSource, run: Path) -> SceneSource:
        """Return the scene of the run to resume; its folder may have moved, other options must agree."""
        old, config, _ = read_run(run)
        for flag, default, given, expected in (
            ("--downscale", 1, self.downscale, old.downscale),
            ("--images", "images", self.images, old.images),
            ("--masks", "masks", self.masks, old.masks),
            ("--background", None, self.background, old.background),
            ("--points", None, self.points and str(Path(self.points).resolve()), old.points),
            ("--format", None, self.format, old.format),
            ("--follow-links", False, self.follow_links, old.follow_links),
            ("--skip-missing", False, self.skip_missing, old.skip_missing),
            ("--preset", "default", self.preset, config.preset),
        ):
            if given not in (default, expected):
                raise SettingError(f"{flag}: expected {expected} as in the run to resume, got {given}")
        return dataclasses.replace(old, path=source.path)

    def _config(self, run: Path, resume: bool = False) -> Config:
        """Return the settings of preset and options, or those of the run to resume, which options must agree with."""
        flags: dict[str, Json] = {
            "iterations": self.iterations,
            "max_surfels": self.max_surfels,
            "max_hits": self.max_hits,
            "seed": self.seed,
            "mask_mode": self.mask_mode,
            "deterministic": self.deterministic or None,
            "refine_poses": self.refine_poses or None,
        }
        given: dict[str, Json] = {name: value for name, value in flags.items() if value is not None}
        check_max_hits(self.max_hits)
        settings = self._settings(given)
        if resume:
            return self._resumed_config(run, given, settings)
        base = preset(self.preset)
        if self.scene == DEMO:
            base = with_settings(base, DEMO_SETTINGS)
        config = with_flag_settings(with_settings(base, given), settings)
        self._check_teachers(run, config)
        return config

    def _check_teachers(self, run: Path, config: Config) -> None:
        """Raise SettingError for a teacher that the run would replace, and for poses that teachers do not follow."""
        for path in self.teachers:
            if path.resolve().is_relative_to(run.resolve()):
                raise SettingError(f"--teacher: expected another run than {run}, which is written, got {path}")
        if self.teachers and config.refine_poses:
            raise SettingError("--teacher: expected poses that stay as given, got --refine-poses")

    def _resumed_config(self, run: Path, given: dict[str, Json], settings: dict[str, Json]) -> Config:
        """Return the settings of the run to resume; a SettingError names an option that differs."""
        config = read_run(run)[1]
        for name, value in given.items():
            if name == "iterations" and isinstance(value, int) and value > config.iterations:
                config = dataclasses.replace(config, iterations=value)
            elif getattr(config, name) != value:
                flag = f"--{name.replace('_', '-')}"
                raise SettingError(f"{flag}: expected {getattr(config, name)} as in the run to resume, got {value}")
        changed = with_flag_settings(config, settings)
        for name in settings:
            old, new = setting(config, name), setting(changed, name)
            if name == "cuda_graphs":  # does not change the results
                config = dataclasses.replace(config, cuda_graphs=changed.cuda_graphs)
            elif old != new:
                raise SettingError(f"--set: {name}: expected {old} as in the run to resume, got {new}")
        return config

    def _settings(self, given: dict[str, Json]) -> dict[str, Json]:
        """Return the settings of --set; those that are also given as an option of their own are refused."""
        try:
            settings = parse_settings(self.settings)
        except ValueError as error:
            raise SettingError(f"--set: {error}") from None
        for name in settings:
            if name == "preset" or name in given:
                flag = f"--{name.replace('_', '-')}"
                raise SettingError(f"--set: {name}: expected {flag} instead of --set")
        return settings


def _tell_foreign(console: Console, run: Path, names: list[str]) -> None:
    """Say which files an overwritten run folder keeps."""
    if names:
        kept = f"{names[0]} and {len(names) - 1} more" if len(names) > 1 else names[0]
        display.warn(console, f"{run}: not deleted, as nexwarp did not write it: {kept}")
