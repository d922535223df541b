"""Training from Python."""

from collections.abc import Callable, Iterable, Mapping

import torch
from typing_extensions import Unpack

from nexwarp.data import Scene
from nexwarp.errors import check_type
from nexwarp.model.model import Model
from nexwarp.train.initial import Start, check_start
from nexwarp.train.losses import OwnLoss
from nexwarp.train.recipe import Config
from nexwarp.train.report import StepReport
from nexwarp.train.stages import StageRunner, StageStore, load_kernels

Callback = Callable[[StepReport], object]


def train(
    scene: Scene,
    config: Config | None = None,
    *,
    device: torch.device | str | None = None,
    callbacks: Iterable[Callback] = (),
    losses: Mapping[str, OwnLoss] | None = None,
    teachers: Iterable[Model] = (),
    **start: Unpack[Start],
) -> Model:
    """Train a scene and return the finished model, as `nexwarp train` does, without writing files.

    On a CPU, and with `config.deterministic` on CUDA, the same arguments give the same bits.

    Args:
        scene: what to learn from: its training views and points.
        config: settings; None is `nexwarp.preset("default")`.
        device: where to train; None is CUDA where there is a device, else the CPU.
        callbacks: functions that are called with a `StepReport` after each step, first those of teachers that the run
            trains. One that raises stops it; its exception is passed on.
        losses: own losses by name: functions of the step's `Rendering`, at the photo's exposure, and its `Target`
            (`target.photo` (H, W, 3), `target.camera`, `target.background`, `target.counts`) that return a scalar
            tensor. They are added to ours as they are, so that factors are their own business, and appear in
            `StepReport.losses` by their names. On CUDA, steps are replayed as CUDA graphs: a loss may then depend on
            tensors, which it reads in place, but not on numbers that change in Python, for which set
            `config.cuda_graphs` to False. A loss that cannot be captured, such as one that calls `item()`, warns, and
            steps are launched one by one.
        teachers: trained models of the scene, in place of the run's own (`config.teachers`); they are moved to the
            device. Every other step compares with a rendering of one, at the mean exposure, from a camera on the line
            through those of two photos.
        start: `surfels`: surfels to start from instead of the scene's points, at most `config.max_surfels`, in the
            scene's frame. `init`: a model of the scene to start from, with its texture. SH coefficients of both above
            `config.sh_degree` are dropped. `texture`: a `Texture` of your own, which is trained in place; or a class or
            function that makes one, the class without arguments, the function of the scene and the initial surfels.
            Its parameters are trained as the group "texture" at its `rates`, and its `regulariser` is added to the
            loss. Teachers that the run trains for itself start as ever.

    Returns:
        The finished model on the device.

    Raises:
        SceneError: the scene has no training views.
        TypeError, ValueError: naming the argument that does not fit.
        DivergedError: numbers are not finite.
        OutOfMemoryError: memory does not suffice; the message says what to lower.
    """
    check_type("scene", scene, Scene)
    check_type("config", config, Config, optional=True)
    config, observers = config or Config(), list(callbacks)
    for index, callback in enumerate(observers):
        if not callable(callback):
            raise TypeError(f"callbacks[{index}]: expected a function, got {type(callback).__name__}")
    check_start(scene, config, start)
    device = device or ("cuda" if torch.cuda.is_available() else "cpu")

    def observe(report: StepReport) -> None:
        for callback in observers:
            callback(report)

    load_kernels(config, device)
    store = StageStore(observe)
    runner = StageRunner(scene, config, device, store, losses=losses, teachers=teachers, **start)
    runner.train()
    return runner.finish()
