import json
import math

import numpy as np
import pytest
import torch

import nexwarp as nw
from nexwarp.cameras.paths import look_at, up_direction
from nexwarp.cameras.similarity import IDENTITY, Similarity, upright
from nexwarp.errors import FormatError
from nexwarp.model import edit
from nexwarp.model.edit import EDIT_FILE, Edit, checksum, frame_of, kept_surfels, moved_surfels, read_edits, write_edits
from nexwarp.model.floaters import find_floaters
from tests.scenes import make_camera, make_surfels, random_scene, rigid
from tests.tolerances import assert_close

MOTION = Similarity(rigid((0.4, -0.5, 0.7, 0.3), (0, 0, 0))[:3, :3].numpy(), np.array([3.0, -1.0, 2.0]), 2.5)


def test_motions_follow_each_other_and_lead_back():
    points = np.random.default_rng(0).normal(size=(9, 3))
    other = Similarity(MOTION.rotation.T, np.array([0.0, 5.0, 1.0]), 0.3)
    assert np.allclose(MOTION.then(other).points(points), other.points(MOTION.points(points)))
    assert np.allclose(MOTION.inverse().points(MOTION.points(points)), points)
    assert MOTION.then(MOTION.inverse()).scale == 1 and IDENTITY.is_identity and not MOTION.is_identity


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_moved_surfels_look_the_same_to_the_moved_camera(dtype):
    """Shape, harmonics of all degrees and order; depths are in the new units, normals in the new axes.

    The near plane lies amid the surfels.
    """
    scene = random_scene(dtype=dtype) | {"near": 2.5}
    surfels, camera = make_surfels(scene), make_camera(scene)
    with torch.no_grad():
        before = nw.render(surfels, None, camera)
        after = nw.render(moved_surfels(surfels, MOTION), None, MOTION.camera(camera))
    assert_close(after.image, before.image, kind="value", name="image")
    assert MOTION.camera(camera).near == pytest.approx(camera.near * MOTION.scale)
    assert_close(after.median_depth, before.median_depth * MOTION.scale, kind="value", name="depth")
    turn = torch.from_numpy(MOTION.rotation).to(before.normals)
    assert_close(after.normals, before.normals @ turn.T, kind="gradient", name="normals")


@pytest.mark.parametrize("up", [(0.1, 0.9, 0.3), (0.05, -1.0, -0.2), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)])
def test_the_upward_direction_becomes_y(up):
    target, direction = torch.zeros(3).double(), torch.nn.functional.normalize(torch.tensor(up).double(), dim=0)
    side = torch.linalg.cross(direction, torch.tensor([0.3, 0.2, 0.7]).double())
    places = [4 * side, -3 * side + direction, torch.linalg.cross(side, direction)]
    K = torch.tensor([[50.0, 0, 20], [0, 50, 15], [0, 0, 1]])
    cameras = [nw.Camera(look_at(place, target, direction), K.double(), 40, 30) for place in places]
    turn = upright(cameras)
    assert np.allclose(turn @ up_direction(cameras).numpy(), [0, 1, 0]) and np.isclose(np.linalg.det(turn), 1)
    levelled = [Similarity(turn, np.zeros(3)).camera(camera) for camera in cameras]
    assert np.allclose(upright(levelled), np.eye(3), atol=1e-6)


def test_a_crop_keeps_what_lies_inside_in_the_coordinates_before_it():
    surfels = make_surfels(random_scene(40))
    means = surfels.means.detach().double().numpy()
    box = tuple(np.quantile(means, (0.1, 0.8), axis=0).ravel().tolist())
    within = np.array([all(low <= x <= high for low, x, high in zip(box[:3], p, box[3:], strict=True)) for p in means])
    assert 0 < within.sum() < 40 and (kept_surfels(surfels, [Edit("box", box)]) == within).all()
    centre = np.median(means, axis=0)
    near = np.linalg.norm(means - centre, axis=1) <= 0.8
    edits = [Edit("scale", (2.0,)), Edit("origin", tuple((2 * centre).tolist())), Edit("sphere", (0, 0, 0, 1.6))]
    assert (kept_surfels(surfels, [*edits, Edit("scale", (9.0,))]) == near).all(), "later edits move what is left"
    kept, frame = kept_surfels(surfels, edits), frame_of(edits)
    assert 0 < near.sum() < 40 and (kept == near).all() and np.allclose(frame.points(means), 2 * (means - centre))


def spread(count: int) -> torch.Tensor:
    """Directions (N, 3) all around, evenly."""
    index = torch.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, index * math.pi * (1 + 5**0.5)
    return torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], dim=1)


def sphere_model(planted: torch.Tensor, opacities: torch.Tensor) -> nw.Model:
    """An opaque ball of 600 surfels, and planted surfels that face its middle."""
    normals = torch.cat([spread(600), torch.nn.functional.normalize(planted, dim=1)])
    # The half-way rotation from z to the normal.
    quats = torch.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], torch.zeros(len(normals))], dim=1)
    count, opacities = len(normals), torch.cat([torch.full((600,), 0.98), opacities])
    means, scales, gammas = torch.cat([spread(600), planted]), torch.full((count, 2), 0.12), torch.full((count, 2), 1.5)
    surfels = nw.Surfels.from_activated(means, quats, scales, opacities, gammas, torch.zeros(count, 1, 3))
    return nw.Model(surfels, None)


def test_planted_floaters_go_and_the_rest_stays():
    """Faint ones before everything, and opaque ones close before one camera."""
    K, up = torch.tensor([[240.0, 0, 32], [0, 240, 32], [0, 0, 1]]), torch.tensor([0.1, 0.2, 1.0])
    cameras = [nw.Camera(look_at(4 * place, torch.zeros(3), up), K, 64, 64) for place in spread(40)]
    shares = torch.cat([torch.linspace(0.45, 0.8, 30), torch.full((10,), 0.9)])
    model = sphere_model(shares[:, None] * 4 * spread(40), torch.tensor([0.05] * 30 + [0.9] * 10))
    stages = []
    found = find_floaters(model, cameras, lambda *stage: stages.append(stage))
    assert found[600:].all() and found[:600].sum() <= 0.005 * 600 and len(stages) == 80 and stages[-1][1:] == (40, 40)
    assert not find_floaters(edit.select(model, ~found), cameras).any(), "they go at once"
    kept = kept_surfels(model.surfels, [Edit("remove", (checksum(model.surfels), *found.nonzero()[:, 0].tolist()))])
    assert (kept == ~found.numpy()).all()
    for numbers in ((checksum(model.surfels), len(model.surfels)), (checksum(model.surfels) + 1, 4)):
        with pytest.raises(ValueError, match="has changed"):
            kept_surfels(model.surfels, [Edit("remove", numbers)])


def test_edits_come_back_from_their_file(tmp_path):
    rotation = tuple(MOTION.rotation.ravel().tolist())
    edits = [Edit("box", (0, 0, 0, 1, 2, 3.5)), Edit("level", (*rotation, 0, 1, 2)), Edit("remove", (7, 1, 2))]
    write_edits(tmp_path, edits)
    assert read_edits(tmp_path) == edits
    assert str(edits[0]) == "crop box 0 0 0 1 2 3.5" and str(edits[2]) == "remove 2 floaters"
    write_edits(tmp_path, [])
    assert read_edits(tmp_path) == [] and not (tmp_path / EDIT_FILE).exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ('{"format_version": 2, "edits": []}', "update nexwarp"),
        ('{"format_version": 1, "edits": 3}', "edits of a model"),
        ('{"format_version": 1, "edits": [{"name": "paint", "numbers": [1]}]}', "paint"),
        ('{"format_version": 1, "edits": [{"name": "scale", "numbers": [0]}]}', "scale: expected at least"),
        ('{"format_version": 1, "edits": [{"name": "scale", "numbers": [true]}]}', "numbers"),
        ('{"format_version": 1, "edits": [{"name": "origin", "numbers": [NaN, 0, 0]}]}', "NaN"),
        ('{"format_version": 1, "edits": [{"name": "box", "numbers": [0, 0, 0, 1, 0, 1]}]}', "lowest"),
        ('{"format_version": 1, "edits": [{"name": "remove", "numbers": [1, -2]}]}', "indices"),
        (json.dumps({"format_version": 1, "edits": [{"name": "level", "numbers": [1.0] * 12}]}), "rotation"),
    ],
)
def test_damaged_files_are_refused_in_one_line(content, words, tmp_path):
    (tmp_path / EDIT_FILE).write_text(content)
    with pytest.raises(FormatError) as caught:
        read_edits(tmp_path)
    assert words in str(caught.value) and EDIT_FILE in str(caught.value) and "\n" not in str(caught.value)
