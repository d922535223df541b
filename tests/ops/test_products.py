"""Steps and frames leave products of matrices to their own kernels: cuBLAS keeps 32 MiB a stream once it is called."""

import torch
from torch.utils._python_dispatch import TorchDispatchMode

import nexwarp as nw
from tests.trainer_support import small

PRODUCTS = {"mm", "mv", "bmm", "addmm", "addmv", "addbmm", "baddbmm", "dot", "vdot", "addr"}


class Products(TorchDispatchMode):
    """Lists the products of matrices that torch is asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = str(func).split(".")[1]
        if name in PRODUCTS:
            self.found.append(name)
        return func(*args, **(kwargs or {}))


def test_steps_and_frames_call_no_blas(tiny_scene: nw.Scene) -> None:
    trainer = nw.Trainer(tiny_scene, small(), "cpu")
    with Products() as step:
        for _ in range(4):  # rounds of density control among them
            trainer.step()
    assert step.found == []
    model = trainer.finish()
    cameras = [view.camera for view in tiny_scene.train]
    model.exposures = nw.Exposures.of(0.05 * torch.randn(len(cameras), 3), cameras, (-0.2, -0.05, 1.0))
    assert model.detail_limits is not None
    with Products() as frame, torch.no_grad():
        model.render(tiny_scene.test[0].camera)
    assert frame.found == []
    with Products() as seen:
        _ = torch.ones(2, 2) @ torch.ones(2)
    assert seen.found == ["mv"]
