import pytest
import torch

import nexwarp as nw
from nexwarp.kernels import launch
from nexwarp.machine import in_threads
from nexwarp.ops.photometric import depth_term
from nexwarp.train.recipe import Config, DensifyConfig, TextureConfig
from nexwarp.train.trainer import Trainer
from tests.narrowing import present
from tests.render_support import Passes, leaf
from tests.scene_writers import write_demo
from tests.scenes import Scene, layered_scene, make_texture, random_scene
from tests.tolerances import assert_close

pytestmark = pytest.mark.usefixtures("restore_threads")

BIG = {"width": 61, "height": 45}
# 19 x 13 tiles: a sixteenth of their pixels is no whole number of tiles, which once split a tile between two threads.
WIDE = {"width": 300, "height": 200}


def errors_of(scene: Scene, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    generator = torch.Generator().manual_seed(9)
    return torch.rand(scene["height"], scene["width"], generator=generator, dtype=torch.float64).to(dtype)


def assert_identical(results: list[dict[str, torch.Tensor]]) -> None:
    """Fail unless all results agree to the last bit, and hold something."""
    for name, first in results[0].items():
        assert bool(first.any()), name
        assert all(torch.equal(first, other[name]) for other in results[1:]), name


@pytest.mark.parametrize("size", [BIG, WIDE])
def test_collect_does_not_depend_on_threads(size):
    scene = random_scene(600, **size)
    errors = errors_of(scene)
    results = []
    for count in (1, 2, 3, 20):  # 20 threads share more chunks
        launch.set_num_threads(count)
        passes = Passes(scene)
        request = passes.hits.error_request
        request.errors = errors
        results.append(passes.buffers() | {"blended": passes.blended(errors)})
        results[-1] |= {f"grad_{name}": grad for name, grad in passes.gradients().items()}
        results[-1]["requested"] = present(request.sums_after_backward)
    assert len(launch.chunks(4 * 3 * 16**2, 16**2, 16**2, 16)) > 3  # there was something to share out
    assert_identical(results)


@pytest.mark.parametrize("turned", [False, True], ids=["fixed", "turned"])
def test_texture_does_not_depend_on_threads(turned):
    """Colours are computed in few kernels where directions are fixed; 10,000 points have five parts."""
    texture = make_texture()
    generator = torch.Generator().manual_seed(4)
    count, hits = 5000, 2
    positions = 3 * torch.randn(count, hits, 3, generator=generator)
    depths = 1 + torch.rand(count, hits, generator=generator)
    depths[::7, 1] = 0.0  # empty slots
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    results = []
    for threads in (1, 2, 3):
        launch.set_num_threads(threads)
        inputs = {"positions": leaf(positions), "depths": leaf(depths), "directions": leaf(directions)}
        toward = inputs["directions"] if turned else inputs.pop("directions").detach()
        out = texture.evaluate(inputs["positions"], inputs["depths"], toward, 24.0)
        factors = torch.randn(out.shape, generator=torch.Generator().manual_seed(1))
        leaves = inputs | dict(texture.named_parameters())
        grads = torch.autograd.grad((out * factors).sum(), list(leaves.values()))
        results.append({"out": out.detach()} | dict(zip(leaves, grads, strict=True)))
    assert_identical(results)


@pytest.mark.parametrize("make", [random_scene, layered_scene])
def test_blended_error_is_the_gradient_to_the_colours(make):
    """With K = 0 the image is sum w c, so d(sum error * image) / dc = sum w error, for any number of hits."""
    scene = make(40, seed=2)
    errors = errors_of(scene)
    passes = Passes(scene, max_hits=0)
    (gradient,) = torch.autograd.grad((passes.hits.plain * errors[..., None]).sum(), passes.colors)
    for channel in range(3):
        assert_close(passes.blended(errors), gradient[:, channel], kind="value", name="blended")


def test_the_backward_pass_gives_the_blended_error_on_request():
    scene = random_scene(40, seed=5)
    errors = errors_of(scene)
    passes = Passes(scene)
    request = passes.hits.error_request
    request.errors = errors
    requested = passes.gradients()
    assert request.sums_after_backward is not None
    assert_close(request.sums_after_backward, passes.blended(errors), kind="value", name="sums")
    plain = Passes(scene).gradients()
    assert all(torch.equal(requested[name], plain[name]) for name in plain)


def test_training_does_not_depend_on_threads(tmp_path):
    """Neither on those of the kernels nor on torch's, whose BLAS adds up in another order with another number."""
    scene = nw.load_scene(write_demo(tmp_path / "scene", width=96, height=72, views=4, points=500))
    texture = TextureConfig(levels=12, table_size=2**12, width=32)
    config = Config(iterations=40, max_surfels=2000, texture=texture, densify=DensifyConfig(every=3))
    models = []
    for kernels, others in ((1, 1), (2, 3), (3, 4)):
        launch.set_num_threads(kernels)
        torch.set_num_threads(others)
        trainer = Trainer(scene, config, "cpu")
        for _ in range(4):
            trainer.step()
        models.append(dict(trainer._named_parameters()) | {"errors": trainer.densifier.errors})
        assert torch.get_num_threads() == others
    assert_identical([{name: x.detach() for name, x in model.items()} for model in models])


def test_many_points_in_one_pixel_add_up_in_order():
    """Whatever the threads, as a thread has a pixel."""
    generator = torch.Generator().manual_seed(0)
    shape, count = (40, 30, 2), 60_000
    depths = 1 + torch.rand(shape, generator=generator)
    row, column = torch.randint(40, (count,), generator=generator), torch.randint(3, (count,), generator=generator)
    places = (row * 30 + column).sort().values
    expected = 1 + torch.rand(count, generator=generator)
    results = []
    for threads in (1, 4, 4, 7):
        torch.set_num_threads(threads)
        weights = torch.full(shape, 0.3, requires_grad=True)
        depth_term(depths, weights, expected, places).backward()
        results.append({"weights": present(weights.grad)})
    assert_identical(results)


def test_threads_of_small_work_have_one_torch_thread_each_and_keep_the_order():
    torch.set_num_threads(3)
    nested = list(in_threads(lambda i: (i, torch.get_num_threads(), *in_threads(int, [i])), range(40)))
    assert nested == [(i, 1, i) for i in range(40)]
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda i: 1 / i, [1, 0, 2]))
    assert torch.get_num_threads() == 3
