"""Small faults, one at a time, in a copy of the tree: does the test that should see it fail?

python -m tests.robustness.mutations [N ...]      # all take half an hour; exit code 1 where one survives
"""

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
AGREE = "tests/robustness/test_agreement.py -k reference"
WEB = "tests/export/web/test_webgpu.py -k buffers"
BAKED = "tests/export/web/test_page.py -k baked_scene"
HARMONICS = "tests/export/web/test_scene_file.py -k harmonics"
DENSE = "tests/train/test_densify.py"
KERNELS, SHADERS, PAGE = "kernels/", "export/web/shaders/", "export/web/page/"


class Mutation(NamedTuple):
    """A fault in a file of the package, and the arguments of pytest that should show it."""

    file: str
    old: str
    new: str
    tests: str


MUTATIONS = [
    # 1: kernels
    Mutation(KERNELS + "types.py", "ALPHA_MAX = 0.99\n", "ALPHA_MAX = 0.999\n", AGREE),
    Mutation(KERNELS + "types.py", "ALPHA_MIN = 1.0 / 255.0", "ALPHA_MIN = 1.0 / 256.0", AGREE),
    Mutation(KERNELS + "types.py", "TRANSMITTANCE_MIN = 1e-4", "TRANSMITTANCE_MIN = 2e-4", AGREE),
    Mutation(KERNELS + "shape.py", "-0.5 / math.log(2.0)", "-0.501 / math.log(2.0)", AGREE),
    Mutation(KERNELS + "shape.py", "wp.where(alpha < type(u)(CAP), grad_alpha", "wp.where(True, grad_alpha", AGREE),
    Mutation(KERNELS + "shape.py", "half / gamma[1])", "half / gamma[0])", AGREE),
    Mutation(KERNELS + "surfel.py", "grad_m = grad_depth * inverse", "grad_m = -grad_depth * inverse", AGREE),
    Mutation(KERNELS + "surfel.py", "two * (x * z - w * y)),", "two * (x * z + w * y)),", AGREE),
    Mutation(KERNELS + "walk.py", "half = type(view.near)(0.5)", "half = type(view.near)(0.49)", AGREE),
    Mutation(KERNELS + "collect.py", "displaced or weight > w_", "displaced or weight >= w_", "tests/ops -k equal_weights"),
    Mutation(KERNELS + "collect.py", "if alpha >= ALPHA_MIN and depth > view.near and", "if alpha >= ALPHA_MIN and", AGREE),
    Mutation(KERNELS + "collect_backward.py", "alpha >= ALPHA_MIN and depth > view.near)", "alpha >= ALPHA_MIN)", AGREE),
    Mutation(KERNELS + "collect_backward.py", "rest / (ONE - alpha)", "rest", AGREE),
    Mutation(KERNELS + "collect_backward.py", "plain_weight = ZERO", "plain_weight = weight", "tests/ops/test_rasterize.py"),
    Mutation(KERNELS + "compose.py", "(ONE - layers.alphas[p])", "layers.alphas[p]", AGREE),
    Mutation(KERNELS + "compose.py", "-wp.dot(of_image, layers.background[0])", "wp.dot(of_image, layers.background[0])", AGREE),
    Mutation(KERNELS + "hashgrid.py", "2 * i - 1, -2 * i", "2 * i, -2 * i", AGREE),
    Mutation(KERNELS + "hashgrid.py", "wp.uint32(805459861)", "wp.uint32(805459863)", AGREE),
    Mutation(KERNELS + "hashgrid.py", "1.0 / (2.0 * math.pi)", "1.0 / (2.1 * math.pi)", AGREE),
    Mutation(KERNELS + "sh.py", "0.4570457994644658", "0.4593", "tests/kernels/test_sh.py"),
    Mutation(KERNELS + "sh.py", "if color[c] > type(color[c])(0.0)", "if color[c] >= type(color[c])(0.0)", "tests/kernels/test_sh.py"),
    Mutation(KERNELS + "detail.py", "opacity * x * y, wp.vector", "opacity * x, wp.vector", "tests/ops/test_antialias.py"),
    Mutation(KERNELS + "adam.py", "* correction + epsilon)", "+ epsilon)", "tests/ops/test_adam.py"),
    Mutation(KERNELS + "adam.py", "(root(v[k]) * correction + epsilon)", "((root(v[k]) + epsilon) * correction)", "tests/ops/test_adam.py -k epsilon"),
    Mutation(KERNELS + "photometric.py", "terms[1], ONE - weight)", "terms[1], weight)", "tests/ops/test_photometric.py"),
    Mutation(KERNELS + "ssim.py", "C2 = 0.03**2", "C2 = 0.01**2", "tests/train/test_losses.py tests/kernels/test_ssim.py"),
    Mutation(KERNELS + "project.py", "b = wp.cross(center, v1)", "b = wp.cross(center, v2)", AGREE),
    Mutation(KERNELS + "tiles.py", "wp.constant(wp.float64(0.999))", "wp.constant(wp.float64(1.5))", AGREE),
    # 29: data and cameras
    Mutation("data/lens.py", "+ p2 * (r + 2 * x * x)", "+ p2 * (r + x * x)", "tests/data/test_lens.py tests/data/inputs/test_lenses.py"),
    Mutation("data/lens.py", "width / self.width, height / self.height", "width / self.width, width / self.width", "tests/data/test_scene.py"),
    Mutation("data/colmap.py", "Rotation3d(np.array([x, y, z, w]))", "Rotation3d(np.array([x, y, z, -w]))", "tests/data/test_scene.py"),
    Mutation("data/colmap.py", "models[0] if len(models) == 1 else max(", "models[0] if models else max(", "tests/data"),
    Mutation("data/images.py", "WHITE = 128", "WHITE = 200", "tests/data/inputs/test_masks.py"),
    Mutation("data/transforms.py", "applied[:3] *= number_of(", "applied[:3] /= number_of(", "tests/data/inputs/test_formats.py -k applied"),
    Mutation("cameras/nerfstudio.py", "for values in (frame, file):\n        for axis", "for values in (file, frame):\n        for axis", "tests/data/inputs/test_transforms.py"),
    Mutation("cameras/ray_camera.py", "(x / width - 0.5) * 2", "(0.5 - x / width) * 2", "tests/cameras/test_ray_cameras.py"),
    Mutation("cameras/camera.py", "return (depths > 0) &", "return (depths > -1e9) &", "tests/cameras tests/train/test_losses.py -k 'visible or points'"),
    Mutation("data/skybox.py", "2 * empty > seen", "2 * empty < seen", "tests/data/test_skybox.py"),
    # 39: training
    Mutation("train/densify.py", "log_scales[at, axis] -=", "log_scales[at, axis] +=", DENSE),
    Mutation("train/densify.py", "value.index_fill_(0, children, 0)\n        return", "pass\n        return", DENSE),
    Mutation("train/densify.py", "/ errors\n", "* errors\n", DENSE),
    Mutation("train/densify.py", "c.start < iteration - late < c.stop", "c.start <= iteration - late <= c.stop", DENSE),
    Mutation("train/optimizer.py", "cells_unit) ** 3", "cells_unit) ** 2", "tests/ops/test_adam.py"),
    Mutation("train/losses.py", '"l1": 1.0 - factors.dssim', '"l1": 1.0', "tests/train/test_losses.py"),
    Mutation("train/optimizer.py", "EPSILON = 1e-15", "EPSILON = 1e-8", "tests/train/test_trainer.py -k log_linear"),
    Mutation("train/parallel.py", "1.0 / self.views_a_step if", "1.0 / ranks.size if", "tests/train/test_parallel.py -k incomplete"),
    Mutation("train/target.py", "(1 - alpha)[..., None] * (background", "alpha[..., None] * (background", "tests/train/test_masks.py tests/data/inputs/test_transparency.py -k background"),
    Mutation("train/exposure.py", "1 / (1 + (left / NOISE) ** 2)", "1 / (1 + (left / NOISE))", "tests/model/test_exposures.py -k 'gains or falloff'"),
    Mutation("model/exposures.py", "log_gains.clamp(self.log_gains.amin(0), self.log_gains.amax(0)).exp()", "log_gains.exp()", "tests/model/test_exposures.py"),
    Mutation("model/options.py", 'check_range("background", value, -LARGEST_COLOR', 'check_range("background", value, 0 * LARGEST_COLOR', "tests/model -k background"),
    # 51: export and the page
    Mutation("export/splats.py", 'raw["shN"].mT.flatten(1)', 'raw["shN"].flatten(1)', "tests/export/test_export.py"),
    Mutation("export/splats.py", "SPACING = 1.4", "SPACING = 2.4", "tests/export/test_export.py"),
    Mutation("export/mesh.py", "vertices + origin, -normals", "vertices + origin, normals", "tests/export/test_export.py"),
    Mutation("export/web/quantise.py", "low, high = (logs[known].min()", "low, high = (logs.min()", "tests/export/web/test_scene_file.py"),
    Mutation(SHADERS + "collect.wgsl", "alpha >= ALPHA_MIN && depth > near", "alpha >= ALPHA_MIN", "tests/export/web/test_webgpu.py -k near"),
    Mutation(SHADERS + "collect.wgsl", "out_weight > slot_weights[j]", "out_weight >= slot_weights[j]", "tests/export/web/test_webgpu.py -k equal"),
    Mutation(SHADERS + "common.wgsl", "-0.4570457994644658 * x", "-0.4593 * x", HARMONICS),
    Mutation(SHADERS + "compose.wgsl", "(1.0 - plain.w) * frame.background", "plain.w * frame.background", WEB),
    Mutation(SHADERS + "shade.wgsl", "let fade = 1.0 - exp(", "let fade = 1.01 - exp(", WEB),
    Mutation(SHADERS + "project.wgsl", "opacity *= share.x * share.y", "opacity *= share.x", WEB),
    Mutation(PAGE + "baked_shaders.js", "c += 1.445305721320277 *", "c += 1.4525 *", HARMONICS),
    Mutation(PAGE + "baked_shaders.js", "x.z - 2.0 * near", "x.z", BAKED),
    Mutation(PAGE + "baked_shaders.js", "color * alpha, alpha", "color, alpha", BAKED),
    # 64: files, locks, judgement
    Mutation("io/files.py", "sync(temporary)\n            os.replace", "pass\n            os.replace", "tests/robustness/test_power_cut.py -k loses"),
    Mutation("io/files.py", "os.replace(temporary, path)", "path.write_bytes(temporary.read_bytes())", "tests/robustness/test_faults.py -k 'eval or cameras'"),
    Mutation("io/ply.py", 'newbyteorder("<")', 'newbyteorder(">")', "tests/export/test_export.py"),
    Mutation("model/compact.py", "root = vectors * values", "root = vectors / values", "tests/model/test_compact_files.py"),
    Mutation("run/evaluate.py", "mean(dtype=torch.float64).item()", "mean(dtype=torch.float64).item() * 1.001", "tests/run/test_metrics.py"),
    Mutation("run/folder.py", "WITHOUT_LOCKS = (errno.ENOLCK, ", "WITHOUT_LOCKS = (errno.EAGAIN, ", "tests/run/test_run_lock.py"),
]  # fmt: skip


def copy_tree(target: Path) -> None:
    """Copy what git knows of, as it lies here."""
    names = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True).split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target / name)


def seen(tree: Path, mutation: Mutation) -> bool:
    """Whether a test fails with the fault."""
    file = tree / "nexwarp" / mutation.file
    text = file.read_text(encoding="utf-8")
    if text.count(mutation.old) < 1:
        raise SystemExit(f"{mutation.file}: expected {mutation.old!r}, found none")
    file.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]
    command += shlex.split(mutation.tests)
    try:
        environment = os.environ | {"PYTHONPATH": str(tree)}
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True)
    finally:
        file.write_text(text, encoding="utf-8")
    if done.returncode not in (0, 1):
        raise SystemExit(f"{mutation.tests}: pytest ended with {done.returncode}\n{done.stdout[-2000:]}")
    return done.returncode == 1


def main(numbers: list[str]) -> int:
    """Apply the mutations with these numbers, from 1; all without any."""
    chosen = [int(number) for number in numbers] or range(1, len(MUTATIONS) + 1)
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder)
        copy_tree(tree)
        for number in chosen:
            mutation, start = MUTATIONS[number - 1], time.perf_counter()
            caught = seen(tree, mutation)
            survivors += [] if caught else [number]
            word = "caught" if caught else "SURVIVED"
            print(
                f"{number:3} {word:8} {time.perf_counter() - start:5.0f} s  {mutation.file}: {mutation.new.strip()!r}",
                flush=True,
            )
    print(f"{len(chosen) - len(survivors)} of {len(chosen)} caught; survivors: {survivors or 'none'}")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
