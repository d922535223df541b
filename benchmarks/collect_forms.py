"""Times what waits for a GPU: forms of collect, D-SSIM, the host's part of a collection, kernels of frames and steps.

python -m benchmarks.collect_forms DATA RUN FOLDER      # one GPU alone, about 60 s
"""

import sys, time, io, cProfile, pstats, itertools
from pathlib import Path
import torch
from benchmarks.collect_forms_kernels import variant
from benchmarks import bench_frame, bench_peers, bench_train_step
from benchmarks.gpu_time import gpu_time
from benchmarks.scenes import cloud, fox, garden, geometry, outputs, random_like
from benchmarks.suite import Options
import importlib

C = importlib.import_module("nexwarp.ops.collect")
data, run, O = Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])
dev = torch.device("cuda", 0)
opt = Options(dev, False, data, run)
large, tiny, trained = garden(data=data).to(dev), cloud(500, 64, 48).to(dev), fox(run, data).to(dev)
base = C.collect_kernel
old = (False, False, False, None)
forms = {"old": lambda real, k, low, size: variant(k, size, *old), "now": base}
for name, a in {
    "branch": (True, False, False, None),
    "staged": (False, True, False, None),
    "both": (True, True, False, None),
    "both9": (True, True, False, (128, 9)),
    "colors": (True, True, True, None),
    "brcolors": (True, False, True, None),
}.items():
    forms[name] = (lambda a: lambda real, k, low, size: variant(k, size, *a))(a)
forms["both64"] = lambda real, k, low, size: variant(k, size, True, True, False, None, 64)
forms["both256"] = lambda real, k, low, size: variant(k, size, True, True, False, None, 256)
blocks = {"both64": 64, "both256": 256}
for scene in (large, trained):
    g = bench_peers.with_gamma_1(geometry(scene)) if scene is large else geometry(scene)
    with torch.no_grad():
        projection = g.project()
        tiles = g.tiles(projection)
        ref = None
        times = {n: [] for n in forms}
        for round in range(25):
            for name, form in forms.items():
                C.collect_kernel = form
                C.BLOCK_DIM = blocks.get(name, 128)
                if round == 0:
                    try:
                        hits = g.collect(projection, tiles)
                    except Exception as e:
                        print("FAILED", name, repr(e)[:200])
                        times.pop(name)
                        continue
                    parts = [hits.plain, hits.base, hits.depths, hits.weights, hits.alpha]
                    if ref is None:
                        ref = parts, hits.ids, hits.stops
                    else:
                        print(
                            name,
                            "diff",
                            [f"{(a - b).abs().max().item():.1e}" for a, b in zip(parts, ref[0])],
                            "ids",
                            (hits.ids != ref[1]).sum().item(),
                            "stops",
                            (hits.stops != ref[2]).sum().item(),
                        )
                elif name in times:
                    s, e = (torch.cuda.Event(enable_timing=True) for _ in range(2))
                    torch.cuda._sleep(2_000_000)
                    s.record()
                    g.collect(projection, tiles)
                    e.record()
                    e.synchronize()
                    times[name].append(s.elapsed_time(e))
        forms = {n: f for n, f in forms.items() if n in times}
        print(
            scene.name[:12],
            "collect ms:",
            ", ".join(f"{n} {sorted(t)[len(t) // 2]:.4f}" for n, t in times.items()),
            flush=True,
        )
C.collect_kernel = base
C.BLOCK_DIM = 128
import nexwarp.kernels.collect_backward as CB


def with_bounds(b):
    (O / f"cb_{b}.py").write_text(
        Path(CB.__file__).read_text().replace("launch_bounds=BLOCK_DIM", f"launch_bounds=(BLOCK_DIM, {b})")
    )
    return importlib.import_module(f"cb_{b}").collect_backward_kernel


sys.path.insert(0, str(O))
backs = {"now": C.collect_backward_kernel, "7": with_bounds(7), "8": with_bounds(8)}
kept = C.collect_backward_kernel
for scene in (large, trained):
    g = bench_peers.with_gamma_1(geometry(scene)) if scene is large else geometry(scene)
    projection = g.project()
    tiles = g.tiles(projection)
    hits = g.collect(projection, tiles)
    outs = outputs(hits)
    signals = random_like(outs)
    times = {n: [] for n in backs}
    ref = None
    for round in range(20):
        for name, form in backs.items():
            C.collect_backward_kernel = form
            s, e = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda._sleep(2_000_000)
            s.record()
            (grad,) = torch.autograd.grad(outs, [projection.records], signals, retain_graph=True)
            e.record()
            e.synchronize()
            if round:
                times[name].append(s.elapsed_time(e))
            elif ref is None:
                ref = grad
            else:
                print(name, "backward diff", f"{(grad - ref).norm().item() / ref.norm().item():.1e}")
    print(
        scene.name[:12],
        "collect backward ms:",
        ", ".join(f"{n} {sorted(t)[len(t) // 2]:.4f}" for n, t in times.items()),
        flush=True,
    )
C.collect_backward_kernel = kept
for scene in (large, trained, tiny):
    g = geometry(scene)

    def forward():
        with torch.no_grad():
            return g.hits()

    m = opt.time("forward", forward, **scene.facts)
    total, kernels = gpu_time(forward, 20)
    print(
        f"{scene.name[:12]} forward wall {m.median:.3f} GPU {total:.3f}:",
        ", ".join(
            f"{k.split('__')[-1].split('_cuda_k')[0][-34:] if '__' in k else k[-60:-30]} {v:.4f}"
            for k, v in sorted(kernels.items(), key=lambda x: -x[1])[:11]
        ),
        flush=True,
    )
    (O / f"forward_{scene.name[:4]}.txt").write_text("\n".join(f"{v:.4f} {k}" for k, v in kernels.items()))
    if scene is tiny:
        t = time.perf_counter()
        for _ in range(300):
            forward()
        torch.cuda.synchronize()
        print(f"host a forward call {(time.perf_counter() - t) / 300 * 1e3:.3f} ms", flush=True)
        p = cProfile.Profile()
        p.enable()
        for _ in range(300):
            forward()
        p.disable()
        s = io.StringIO()
        pstats.Stats(p, stream=s).sort_stats("tottime").print_stats(40)
        (O / "host.txt").write_text(s.getvalue())
        print("\n".join(l[:100] for l in s.getvalue().splitlines()[7:24]), flush=True)
import nexwarp.ops.ssim as ssim

(O / "ssim_old.py").write_text(
    Path(ssim.__file__)
    .read_text()
    .replace("ctx.tiles = image.is_cuda and image.dtype == torch.float32", "ctx.tiles = False")
)
import ssim_old

for h, w in ((1039, 1558), (946, 530)):
    target = torch.rand(h, w, 3, device=dev)
    image = (target + 0.1 * torch.randn_like(target)).requires_grad_()
    for name, m in (("new", ssim), ("old", ssim_old), ("new", ssim), ("old", ssim_old)):
        total, kernels = gpu_time(lambda: torch.autograd.grad(m.weighted_dssim(image, target), image), 20)
        print(
            f"dssim {h}x{w} {name} GPU {total:.4f}:",
            ", ".join(f"{k.split('_cuda_k')[0][-26:]} {v:.4f}" for k, v in kernels.items() if "ssim" in k),
            flush=True,
        )
    a, b = (torch.autograd.grad(m.weighted_dssim(image, target), image)[0] for m in (ssim, ssim_old))
    print("dssim diff", ((a - b).norm() / b.norm()).item())


def kernels_of(name, run, repeats=10):
    total, kernels = gpu_time(run, repeats)
    rows = sorted(kernels.items(), key=lambda x: -x[1])
    (O / f"{name}.txt").write_text(f"{total:.4f}\n" + "\n".join(f"{v:.4f} {k}" for k, v in rows))
    print(f"{name} GPU {total:.3f} kernels {len(rows)}", flush=True)


for name, scene in (("frame_garden", large), ("frame_fox", trained)):
    model = bench_frame.finished(scene)
    cams = itertools.cycle(scene.cameras)

    def frame():
        with torch.no_grad():
            return model.render(next(cams)).image

    frame()
    frame()
    m = opt.time(name, frame, **scene.facts)
    print(f"{name} wall {m.median:.3f}", flush=True)
    kernels_of(name, frame, 30)
for name, scene in (("step_garden", garden(400_000, 1558, 1039, data)), ("step_fox", fox(run, data))):
    trainer = bench_train_step.make_trainer(scene, opt)
    m = opt.time(name, trainer.step, **scene.facts)
    torch.cuda.synchronize()
    t = time.perf_counter()
    for _ in range(300):
        trainer.step()
    torch.cuda.synchronize()
    row = (time.perf_counter() - t) / 300
    print(f"{name} wall {m.median:.3f} in a row {1e3 * row:.3f} peak {m.peak_mib:.0f} MiB", flush=True)
    kernels_of(name, trainer.step, 20)
    del trainer
