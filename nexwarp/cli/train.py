"""`nexwarp train`."""

import dataclasses
import shlex
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from nexwarp.cli import display
from nexwarp.cli.commands import make_scene, needs_cameras, scene_folder_of, show_until_interrupted
from nexwarp.cli.display import device_name
from nexwarp.cli.options import Device_, Host_, Port_, Preset_, joined_ranks
from nexwarp.cli.session import Session
from nexwarp.data import Scene
from nexwarp.data.option import Flag_, option
from nexwarp.data.scene import DEMO, SceneSource
from nexwarp.errors import SettingError, check_package, naming, require
from nexwarp.io.json_files import Json
from nexwarp.model.model_file import load
from nexwarp.model.surfels import Surfels
from nexwarp.run.folder import (
    RunRecord,
    check_teachers_place,
    claimed_run,
    create_run,
    keep_camera_path,
    read_run,
    update_run,
)
from nexwarp.train.initial import Start, check_start
from nexwarp.train.ranks.ranks import Ranks, check_count, is_rank
from nexwarp.train.recipe import DEMO_SETTINGS, Config, parse_settings, preset, setting, with_settings
from nexwarp.train.stages import NO_TEACHERS, StageRunner, load_kernels, plan_teachers, shortened

if TYPE_CHECKING:
    from nexwarp.viewer import Viewer

PLY = ".ply"
SETTINGS = ("iterations", "max_surfels", "max_hits", "seed", "deterministic", "refine_poses")  # with their own options


@dataclass
class Train:
    """Train a scene, evaluate it on its test views, and write everything to a run folder."""

    scene: tyro.conf.OmitArgPrefixes[SceneSource]
    run: Annotated[Path | None, option("RUN", "runs/SCENE")] = None
    """Run folder to write."""
    max_surfels: Annotated[int | None, option("P", "400000; demo 3000")] = None
    """Largest number of surfels."""
    iterations: Annotated[int | None, option("N", "30000; demo 700")] = None
    """Views to train on."""
    max_hits: Annotated[int | None, option("K", "2")] = None
    """K, textured hits of a pixel, 0 to 8."""
    refine_poses: Flag_ = False
    """Correct the training poses (docs/poses.md)."""
    teachers: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(name="teacher", metavar="RUN", help_behavior_hint="(repeatable)"),
    ] = ()
    """Learn from a finished run, too."""
    init: Annotated[Path | None, option("FILE|RUN", "the points")] = None
    """Start from surfels of a .ply, or from a run."""
    preset: Preset_ = "default"
    """Start from fast, web or paper."""
    settings: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(name="set", metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
    ] = ()
    """A setting of docs/options.md."""
    seed: Annotated[int | None, option("N", "0")] = None
    """Random seed."""
    deterministic: Flag_ = False
    """The same bits in each run on CUDA; slower."""
    device: Device_ = None
    """Device to train on."""
    gpus: Annotated[int | None, option("N", "1")] = None
    """Number of GPUs (docs/gpus.md)."""
    resume: Flag_ = False
    """Continue the run (docs/resume.md)."""
    overwrite: Flag_ = False
    """Replace the run; files of others stay."""
    checkpoint_every: Annotated[int | None, option("N", "a tenth, 30 s apart")] = None
    """Save every N steps."""
    view: Flag_ = False
    """Show the training in the browser (extra viewer)."""
    host: Host_ = "127.0.0.1"
    """Address of --view."""
    port: Port_ = 8080
    """Port of --view; 0 picks one."""
    tensorboard: Flag_ = False
    """Also log to RUN/tensorboard (extra tensorboard)."""
    given: Annotated[frozenset[str], tyro.conf.Suppress] = frozenset()
    """The options that were typed: one that equals its default must fit a run to resume, too."""

    def __call__(self, console: Console) -> None:
        """Train."""
        with joined_ranks(self.device, self.gpus) as ranks:
            self._train(ranks, console if ranks.first else Console(quiet=True))

    def starts(self) -> int:
        """Return how many processes this command is to start; 0 if it trains in this one."""
        if is_rank() or self.gpus is None or self.gpus == 1:
            return 0
        check_count(self.gpus, self.device)
        return self.gpus

    def _train(self, ranks: Ranks, console: Console) -> None:
        captured = Path(self.scene.path) if needs_cameras(self.scene) else None  # what the scene is to be made of
        if captured is not None:
            self.scene = dataclasses.replace(self.scene, path=str(scene_folder_of(captured)))
        run = self.run or Path("runs") / self.scene.name
        with ExitStack() as claim:
            record, resume = self._plan(run, ranks, claim)
            teachers = [load(path) for path in record.teachers]  # a wrong path is told before photos are read
            start = _start(record.init, resume)
            if captured is not None:
                if ranks.first:
                    make_scene(captured, console)
                ranks.barrier()
            load_kernels(record.config, ranks.device)
            scene = _load_scene(record, ranks, console)
            with naming("--init"):
                check_start(scene, record.config, start)
            if not resume:
                config = record.config
                if scene.background is not None:
                    expected = "expected --background instead, which also applies to the photos"
                    require("background" not in parse_settings(self.settings), f"--set: background: {expected}")
                    config = dataclasses.replace(config, background=scene.background)
                config = shortened(config, len(scene.train))
                own = NO_TEACHERS if teachers else plan_teachers(config, len(scene.train))
                record = dataclasses.replace(record, config=config, own=own)
            session = Session(run, record, console, ranks, self.resume, self.tensorboard, self.checkpoint_every)
            runner = StageRunner(
                scene, record.config, ranks.device, session, own=record.own, ranks=ranks, teachers=teachers, **start
            )
            if ranks.first and resume:
                before, after = read_run(run).config.iterations, record.config.iterations
                if after > before:
                    text = "learning rates, density control and all other schedules are those of a run of that length"
                    console.print(f"extended from {before:,} to {after:,} iterations: from here on, {text}")
                update_run(run, record)
            elif ranks.first:
                check_teachers_place(run, record.own.count)
            with self._viewer(runner, scene, record, run, console) if ranks.first else nullcontext() as viewer:
                if not resume and ranks.first and (foreign := create_run(run, record)):
                    kept = f"{foreign[0]} and {len(foreign) - 1} more" if len(foreign) > 1 else foreign[0]
                    display.warn(console, f"{run}: not deleted, as nexwarp did not write it: {kept}")
                session.viewer = viewer
                runner.train()
                model = runner.finish()
                quoted = shlex.quote(str(run))
                show = f"nexwarp view {quoted} (in the browser)"
                share = f"nexwarp export {quoted} --format web (a page to share)"
                console.print(f"next: {show}, {share}")
                claim.close()  # while the viewer shows the result, other commands may write to the run
                ranks.close()
                if viewer is not None:
                    viewer.finish(f"{record.config.iterations:,} iterations done", lambda: model)
                    show_until_interrupted(viewer, console)

    def _plan(self, run: Path, ranks: Ranks, claim: ExitStack) -> tuple[RunRecord, bool]:
        """Claim the run folder, on rank 0; return the run, the same on all ranks, and whether to resume it."""
        plan: dict[str, Any] = {}
        if ranks.first:
            self._check()
            claimed = claimed_run(run, self.scene, resume=self.resume, overwrite=self.overwrite)
            resume = claim.enter_context(claimed)
            plan = {"run": self._record(run, resume, ranks).as_dict(), "resume": resume}
        plan = ranks.share(plan)
        record = RunRecord.from_dict(plan["run"])
        # On another machine, the scene may lie elsewhere.
        source = dataclasses.replace(record.source, path=self.scene.path)
        return dataclasses.replace(record, source=source), bool(plan["resume"])

    def _record(self, run: Path, resume: bool, ranks: Ranks) -> RunRecord:
        """Return the run of the options, which must agree with the run to resume."""
        if resume:
            return self._resumed(read_run(run))
        config = self._config()
        for flag, paths in (("--teacher", self.teachers), ("--init", (self.init,))):
            for path in paths:
                if path is not None and path.resolve().is_relative_to(run.resolve()):
                    raise SettingError(f"{flag}: expected another run than {run}, which is written, got {path}")
        if self.teachers and config.refine_poses:
            raise SettingError("--teacher: expected poses that stay as given, got --refine-poses")
        return RunRecord(self.scene, config, ranks.device.type, self.teachers, init=self.init)

    def _config(self) -> Config:
        """Return the settings of a new run."""
        flags, settings = self._settings()
        base = preset(self.preset)
        if self.scene.path == DEMO:
            base = with_settings(base, DEMO_SETTINGS)
        if self.iterations is not None:
            base = dataclasses.replace(base, steps_a_photo=None)
        base = with_settings(base, flags)
        with naming("--set"):
            return with_settings(base, settings)

    def _settings(self) -> tuple[dict[str, Json], dict[str, Json]]:
        """Return the settings that are given as options of their own, and those of --set, which must be others."""
        options = {name: getattr(self, name) for name in SETTINGS}
        flags: dict[str, Json] = {name: x for name, x in options.items() if x is not None and x is not False}
        with naming("--set"):
            settings = parse_settings(self.settings)
        for name in settings:
            require(name not in ("preset", *flags), f"--set: {name}: expected {_flag(name)} instead of --set")
        return flags, settings

    def _resumed(self, old: RunRecord) -> RunRecord:
        """Return the run to resume. Its scene may have moved, and --iterations may be larger; the rest must agree."""
        flags, settings = self._settings()
        scene = self.scene.absolute()
        for field in dataclasses.fields(SceneSource):
            value = getattr(scene, field.name)
            if field.name != "path" and (value != field.default or _flag(field.name) in self.given):
                _check_same(_flag(field.name), getattr(old.source, field.name), value)
        if self.preset != "default" or "--preset" in self.given:
            _check_same("--preset", old.config.preset, self.preset)
        config = old.config
        changed = with_settings(config, flags)
        with naming("--set"):
            changed = with_settings(changed, settings)
        for name in (*flags, *settings):
            value = setting(changed, name)
            # The second one does not change the results.
            if (name == "iterations" and changed.iterations > config.iterations) or name == "cuda_graphs":
                config = with_settings(config, {name: value})
            else:
                _check_same(_flag(name) if name in flags else f"--set: {name}", setting(config, name), value)
        if self.teachers and old.own.count:
            raise SettingError(f"--teacher: expected none, as the run to resume trains its own, got {self.teachers[0]}")
        if self.init is not None:
            _check_same("--init", old.init, self.init.resolve())
        return dataclasses.replace(old, config=config, teachers=self.teachers or old.teachers)

    def _check(self) -> None:
        """Raise SettingError for invalid options, before the photos are read."""
        every = self.checkpoint_every
        require(every is None or every >= 1, f"--checkpoint-every: expected at least 1, got {every}")
        if self.tensorboard:
            check_package("--tensorboard", "tensorboard", "tensorboard")
        if self.view:
            from nexwarp.viewer import listen

            listen(self.host, self.port).close()

    def _viewer(
        self, runner: StageRunner, scene: Scene, record: RunRecord, run: Path, console: Console
    ) -> AbstractContextManager["Viewer | None"]:
        """Return a context with the viewer of the training; with None, without --view."""
        if not self.view:
            return nullcontext()
        from nexwarp.viewer import Viewer, ViewerOptions

        camera, iterations = scene.train[0].camera, record.config.iterations
        save_path = partial(keep_camera_path, run, origin=camera.origin)
        options = ViewerOptions(camera.near, record.source.name, self.host, self.port, iterations, save_path)
        viewer = Viewer(lambda: runner.trainer.model(), scene.cameras, options)
        console.print(f"viewer: {viewer.url}")
        return viewer


def _start(init: Path | None, resume: bool) -> Start:
    """Read what a training starts from, if it is not the scene alone."""
    if init is None:
        return {}
    if init.suffix != PLY:
        return {"init": load(init)}
    return {} if resume else {"surfels": Surfels.load(init)}  # the checkpoint of a run to resume has the surfels


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _check_same(what: str, expected: object, given: object) -> None:
    """Raise SettingError unless an option is that of the run to resume."""
    require(given == expected, f"{what}: expected {expected} as in the run to resume, got {given}")


def _load_scene(record: RunRecord, ranks: Ranks, console: Console) -> Scene:
    """Load the scene, and say what it holds."""
    count = f", {ranks.size} ranks" if ranks.size > 1 else ""
    with display.stages(console) as observe:
        scene = record.source.load(partial(observe, "reading photos"))
    size = scene.train[0].camera
    console.print(f"{record.source.name} on {device_name(ranks.device)}{count}, preset {record.config.preset}")
    console.print(
        f"{len(scene.train)} training and {len(scene.test)} test views of {size.width}x{size.height}, "
        f"{len(scene.points):,} points"
    )
    return scene
