import dataclasses
import re
import shutil
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

import nexwarp as nw
from nexwarp.cli import main as cli
from nexwarp.data.ply import read_vertices
from nexwarp.export import baked_scene
from nexwarp.export.bake import measure
from nexwarp.export.baked_scene import load_baked
from nexwarp.export.glb import make_cards
from nexwarp.export.splats import softened
from nexwarp.run.evaluate import psnr
from nexwarp.run.export import FORMS, ExportOrder, _photos, _trained_on, export_run
from nexwarp.run.folder import open_model, read_metrics
from tests.cli.support import read, refused
from tests.narrowing import present


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr("nexwarp.export.fit.FEWEST_STEPS", 2)


def test_notes_are_in_the_coordinates_of_exports(finished, tmp_path, monkeypatch, capsys):
    """Also where an edit moves and scales them; a headset then shows the scene at that scale."""
    notes = tmp_path / "notes.json"
    notes.write_text('[{"point": [1, 2, 3], "text": "a door"}]')
    export = ["export", str(finished), "--format", "web", "--device", "cpu", "--annotations", str(notes)]
    assert cli.main([*export, "--title", "A <house>", "--background", "white", "--url", "http://x.y/"]) == 0
    page = (finished / "export" / "scene.html").read_text()
    assert '[{"point": [1.0, 2.0, 3.0], "text": "a door"}]' in page and "<h1>A &lt;house&gt;</h1>" in page
    assert 'content="http://x.y/scene.preview.jpg"' in page and 'theme-color" content="#ffffff' in page
    assert cli.main(["edit", str(finished), "--origin", "1", "0", "-2"]) == 0
    assert cli.main(["edit", str(finished), "--scale", "2.5"]) == 0
    pages = []

    def export_web(*_, page, **__):
        pages.append(page)
        return [tmp_path / "x"]

    monkeypatch.setattr("nexwarp.run.export.export_web", export_web)
    opened = open_model(finished)
    export_run(opened, ExportOrder("web", finetune=False, annotations=notes))
    (page,) = pages
    moved = opened.frame.points(np.array(page.notes[0].point))
    assert moved.tolist() == pytest.approx([1, 2, 3]) and page.notes[0].point != (1, 2, 3) and page.metres == 2.5
    notes.write_text('[{"point": [1, 2, 3]}]')
    refused(capsys, export, f"{notes}: entry 1: text")


def test_a_finished_run_becomes_gltf_usd_and_spz(finished, monkeypatch, capsys):
    pytest.importorskip("trimesh")
    refused(capsys, ["export", str(finished), "--format", "glb", "--device", "cpu"], "scene.glb", "opacity above 0.3")
    assert not (finished / "export").exists()
    monkeypatch.setattr("nexwarp.export.glb.CUTOFF", 0.05)  # surfels of a short training are faint
    packages = {"trimesh": ("glb", "scene.glb"), "gaussforge": ("spz", "splats.spz"), "pxr": ("usd", "scene.usdz")}
    for package, (kind, name) in packages.items():
        pytest.importorskip(package)
        assert cli.main(["export", str(finished), "--format", kind, "--device", "cpu"]) == 0
        assert (finished / "export" / name).stat().st_size > 100 and name in capsys.readouterr().out
        (finished / "export" / name).unlink()
        with monkeypatch.context() as patch:
            patch.setattr("importlib.util.find_spec", lambda name: None)
            refused(capsys, ["export", str(finished), "--format", kind, "--device", "cpu"], package, "pip install")
        assert not (finished / "export" / name).exists()
    (finished / "cameras.json").unlink()
    refused(capsys, ["export", str(finished), "--format", "glb", "--device", "cpu"], "cameras.json", "--format glb")


def test_gltf_of_an_object_holds_the_subject_alone(finished, monkeypatch):
    """In the new coordinates, where much lies far around it; unless told to hold all, or what was cropped before."""
    pytest.importorskip("trimesh")
    monkeypatch.setattr("nexwarp.export.glb.CUTOFF", 0.05)  # surfels of a short training are faint
    monkeypatch.setattr("nexwarp.run.edit.subject", lambda cameras: (torch.tensor([0.5, 0, 0]).double(), 1.0))
    assert cli.main(["edit", str(finished), "--scale", "2"]) == 0
    opened = open_model(finished)
    means, lines = opened.frame.points(opened.model.surfels.means.detach().numpy()), list[str]()
    near = np.linalg.norm(means - [1, 0, 0], axis=1) <= 2
    assert 0 < near.sum() < len(near)

    def exported(crop: bool = True) -> np.ndarray:
        file = export_run(open_model(finished), ExportOrder("glb", crop=crop), report=lines.append)[0]
        return load_baked(file).shape.means.numpy()

    with monkeypatch.context() as patch:
        patch.setattr("nexwarp.run.export.FAR_AROUND", 1e3)
        assert (np.linalg.norm(exported() - [1, 0, 0], axis=1) > 2.001).any()
    lines.clear()
    assert (np.linalg.norm(exported() - [1, 0, 0], axis=1) <= 2.001).all()
    size = [float(x) for x in re.findall(r"[\d.]+", lines[0].partition("span")[2])]
    assert lines[0].startswith(f"{(~near).sum()} of {len(near)} surfels") and len(lines) == 2
    assert np.allclose(size, np.ptp(means[near], axis=0), rtol=0.01) and "where nothing was cropped" in lines[1]
    assert (np.linalg.norm(exported(crop=False) - [1, 0, 0], axis=1) > 2.001).any() and len(lines) == 3
    assert cli.main(["edit", str(finished), "--crop", "box", "-50", "-50", "-50", "50", "50", "0.1"]) == 0
    assert (np.linalg.norm(exported() - [1, 0, 0], axis=1) > 2.001).any() and len(lines) == 4


def test_a_collision_mesh_is_in_the_exported_coordinates(finished, capsys, monkeypatch):
    usd = pytest.importorskip("pxr.Usd")
    monkeypatch.setattr("nexwarp.export.glb.CUTOFF", 0.05)
    assert cli.main(["edit", str(finished), "--scale", "2"]) == 0
    command = ["export", str(finished), "--no-crop", "--device", "cpu", "--format"]
    refused(capsys, [*command, "glb", "--collision"], "--collision", "--format usd")
    assert cli.main([*command, "usd", "--collision"]) == 0
    assert cli.main([*command, "mesh"]) == 0
    stage = usd.Stage.Open(str(finished / "export" / "scene.usdz"))
    points = np.array(stage.GetPrimAtPath("/Scene/Collision").GetAttribute("points").Get())
    vertices = read_vertices(finished / "export" / "mesh.ply")
    finer = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    coarse, fine = (np.quantile(x, (0.2, 0.5, 0.8), axis=0) for x in (points, finer))
    assert np.allclose(coarse, fine, atol=0.5)


def test_a_cropped_export_learns_from_the_pixels_that_show_what_is_left(finished, tmp_path):
    assert cli.main(["edit", str(finished), "--crop", "sphere", "0", "0", "0", "6"]) == 0
    source = present(open_model(finished).source)
    photos = present(_photos(open_model(finished), "cpu", lambda *_: None))
    views = {view.name: view for view in (*photos.train, *photos.test)}
    shares = [present(view.mask).double().mean().item() for view in views.values()]
    assert 0.2 < np.mean(shares) < 0.8
    results = {"as it is": baked_files(finished)}
    for inverted in ("beside", "inside"):
        scene = shutil.copytree(source.path, tmp_path / inverted)
        for name, view in views.items():
            file = scene / source.images / name
            with Image.open(file) as photo:
                pixels = np.array(photo.convert("RGB"))
            where = present(view.mask).numpy() == (inverted == "inside")
            pixels[where] = 255 - pixels[where]
            Image.fromarray(pixels).save(file)
        results[inverted] = baked_files(finished, path=str(scene))
    assert results["beside"] == results["as it is"]
    assert results["inside"][0] != results["as it is"][0] and results["inside"][1] != results["as it is"][1]


@pytest.mark.parametrize("form", ["blended cards", "Gaussians"])
def test_what_others_draw_comes_from_a_model_trained_for_it(form, finished, monkeypatch):
    """It is closer to the training photos than the run's own, drawn in the same way."""
    monkeypatch.setitem(FORMS, form, FORMS[form]._replace(share=3))
    opened, calls = open_model(finished), list[tuple[str, int, int]]()
    photos = present(_photos(opened, "cpu", lambda *_: None))
    with patch("nexwarp.run.export.train", wraps=nw.train) as train:
        model, before = _trained_on(opened, photos, "cpu", form, lambda *call: calls.append(call)), opened.model
    rates = train.call_args.args[1].rates
    assert (rates.scales, rates.shN) == pytest.approx((20e-6**0.5, 6.25e-4 * 0.1**0.5))  # the middle of their fall
    if form == "Gaussians":
        before = nw.Model(softened(before.surfels), None, options=before.options)
        assert model.options.max_hits == 0 and model.surfels.gammas.max() < 1.01
        for device, expected in (("cpu", model), ("cuda", before)):  # of the run, exported on a CPU
            export_run(dataclasses.replace(opened, device=device), ExportOrder("ply", max_extent=np.inf))
            assert nw.Surfels.load(finished / "export" / "splats.ply").means.equal(expected.surfels.means)
    else:
        assert model.surfels.shN.shape[1] == 0 and present(model.texture).sh_degree == model.options.sh_degree == 0
    assert len(model.surfels) <= FORMS[form].growth * len(before.surfels) and calls[-1][1:] == (len(calls),) * 2

    def quality(shown: nw.Model) -> float:
        images = [shown.render_image(view.camera, sh_degree=model.options.sh_degree) for view in photos.train]
        return np.mean([psnr(x, view.image, view.mask) for x, view in zip(images, photos.train, strict=True)]).item()

    assert quality(model) > quality(before) + 0.5 and model.options.background == before.options.background
    with pytest.warns(UserWarning, match=f"not trained for {form} .* whose scale"):
        other = dataclasses.replace(photos, scale=2 * photos.scale)
        assert _trained_on(opened, other, "cpu", form, lambda *_: None) is opened.model
    of_gpu = dataclasses.replace(opened, device="cuda")
    assert _trained_on(of_gpu, photos, "cpu", form, lambda *_: None) is of_gpu.model


def test_cut_outs_of_a_hardened_model_show_what_it_shows(finished, monkeypatch):
    monkeypatch.setitem(FORMS, "cut-outs", FORMS["cut-outs"]._replace(share=20))
    opened = open_model(finished)
    photos = present(_photos(opened, "cpu", lambda *_: None))
    hard = _trained_on(opened, photos, "cpu", "cut-outs", lambda *_: None)
    opaque, before = (((x.surfels.opacities - 0.5).abs() > 0.4).float().mean() for x in (hard, opened.model))
    assert hard.surfels.gammas.min() > 2.9 and opaque > 0.8 > before + 0.3

    def kept(model: nw.Model) -> float:
        cards = make_cards(model, *measure(model, photos.train), "mask")
        pairs = [(cards.render(view.camera), model.render_image(view.camera, exposure="mean")) for view in photos.train]
        return np.mean([psnr(*pair) for pair in pairs]).item()

    assert kept(hard) > kept(opened.model) + 3


@pytest.mark.parametrize(
    ("kind", "stages"),
    [
        ("web", {"reading photos": 10, "measuring surfels": 8, "baking the texture": 3}),
        ("mesh", {"choosing the voxel": 8, "finding surfaces": 8, "fusing depths": 8}),
    ],
)
def test_exports_tell_their_stages(kind, stages, finished, capsys):
    """Each counts to its end; where no terminal shows a bar, it is a line."""
    counts: dict[str, list[tuple[int, int]]] = {}

    def observe(stage, done, total):
        counts.setdefault(stage, []).append((done, total))

    export_run(open_model(finished), ExportOrder(kind), observe=observe)
    assert cli.main(["export", str(finished), "--format", kind, "--device", "cpu"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[: len(stages)] == [f"{stage}: {total}" for stage, total in stages.items()]
    assert all(line.isprintable() for line in lines)
    for stage, total in stages.items():
        assert counts[stage] == [(done, total) for done in range(1, total + 1)]


def baked_files(run: Path, path: str | None = None, finetune: bool = True) -> tuple[list[bytes], list[str]]:
    """The files of a run's baked page, whose scene may have moved, and what their export reported."""
    lines: list[str] = []
    opened = open_model(run)
    source = present(opened.source) if path is None else dataclasses.replace(present(opened.source), path=path)
    order = ExportOrder("web", run / "page", finetune=finetune)
    export_run(dataclasses.replace(opened, source=source), order, report=lines.append)
    return [(run / "page" / name).read_bytes() for name in (baked_scene.BAKED_FILE, baked_scene.ATLAS_FILE)], lines


def test_an_export_learns_from_training_photos_alone(finished, tmp_path):
    source = present(open_model(finished).source)
    results = {"as it is": baked_files(finished)}
    figures = read(finished / "page", "metrics.json")["exports"]["index.html"]
    for group in ("test", "train"):
        scene = shutil.copytree(source.path, tmp_path / group)
        for name in open_model(finished).cameras[group]:
            file = scene / source.images / name
            with Image.open(file) as photo:
                ImageOps.invert(photo.convert("RGB")).save(file)
        results[group] = baked_files(finished, path=str(scene))
    files, (line,) = results["as it is"]
    assert results["test"][0] == files and results["test"][1] != [line] and results["train"][0] != files
    psnr, drawn = read_metrics(finished)["psnr"], figures["drawn"]
    counts = f"{drawn['triangles']:,} triangles, a pixel in {drawn['overdraw']:.1f} quads"
    assert re.fullmatch(rf"test PSNR: [\d.]+ dB baked, {psnr:.2f} dB neural, 2 views; [\d.]+ MB; {counts}", line)
    assert drawn["triangles"] == 2 * len(open_model(finished).model.surfels) and drawn["overdraw"] > 0
    assert figures["neural"]["psnr"] == pytest.approx(psnr, abs=1e-3) and set(figures["baked"]) == {"psnr", "ssim"}
    assert f"{figures['baked']['psnr']:.2f} dB baked" in line and not figures["cropped"]
    without, lines = baked_files(finished, finetune=False)
    assert without != files and not lines
    with pytest.warns(UserWarning, match="the photos cannot be read .* nothing is fitted to them"):
        assert baked_files(finished, path=str(tmp_path / "gone")) == (without, [])


@pytest.mark.cuda
@pytest.mark.parametrize("kind", ["web", "glb"])
def test_a_gpu_tells_what_the_cpu_tells(finished, tmp_path, kind):
    lines: list[str] = []
    for device in ("cpu", "cuda"):
        order = ExportOrder(kind, tmp_path / device, alpha="blend")
        export_run(open_model(finished), order, device, report=lines.append)
    cpu, cuda = ([float(x) for x in re.findall(r"([\d.]+) dB", line)] for line in lines)
    assert cuda == pytest.approx(cpu, abs=0.3)
