import numpy as np
import pytest
import torch
from PIL import Image

from nexwarp.data import load_scene
from nexwarp.data.scene import find_format
from tests.data.inputs.support import assert_same_cameras, edit
from tests.data.test_scene import make_scene, project, views_of
from tests.scene_writers import reconstruction_of, write_blender, write_nerfstudio, write_points, write_text


def test_every_format_gives_the_same_scene(demo, tmp_path):
    reference = load_scene(demo)
    for write in (write_text, write_nerfstudio):
        scene = load_scene(write(demo, tmp_path / write.__name__))
        assert_same_cameras(scene, reference)
        torch.testing.assert_close(scene.points, reference.points, rtol=0, atol=1e-6)
        assert torch.equal(scene.colors, reference.colors) and scene.background is None
        assert [v.name for v in scene.train] == [v.name for v in reference.train]
    blender = load_scene(write_blender(demo, tmp_path / "blender"))
    assert_same_cameras(blender, reference)
    assert [v.name for v in blender.test] == ["test/view_000.png", "test/view_008.png"]
    assert blender.background is None and blender.train[0].alpha is None, "its photos are opaque"
    assert load_scene(tmp_path / "blender", background="white").background == (1.0, 1.0, 1.0)


def test_points_beside_a_blender_scene(demo, tmp_path):
    """points3d.ply is taken unless the JSON names others, and may be no link that leads out."""
    path = write_blender(demo, tmp_path / "scene", points=False)
    points, colors = np.random.default_rng(0).normal(size=(20, 3)), np.zeros((20, 3))
    write_points(path / "points3d.ply", points, colors)
    scene = load_scene(path)
    assert np.array_equal(scene.points.numpy(), points.astype(np.float32))
    assert scene.train[0].points is None and scene.track_lengths.eq(0).all()
    assert scene.reprojection_errors.eq(-1).all(), "what the file does not say is unknown"
    write_points(path / "other.ply", 2 * points, colors)
    edit(path, lambda data: data.update(ply_file_path="other.ply"), "transforms_train.json")
    assert np.array_equal(load_scene(path).points.numpy(), (2 * points).astype(np.float32))
    edit(path, lambda data: data.pop("ply_file_path") and None, "transforms_train.json")
    (path / "points3d.ply").rename(tmp_path / "elsewhere.ply")
    (path / "points3d.ply").symlink_to(tmp_path / "elsewhere.ply")
    with pytest.raises(ValueError, match=r"points .points3d.ply.: a link leaves"):
        load_scene(path)


def test_blender_alone_has_an_angle_and_a_centred_square_camera(tmp_path):
    path = make_scene(tmp_path / "colmap", params=(40.0, 40.0, 24.0, 18.0))
    assert_same_cameras(load_scene(write_blender(path, tmp_path / "blender", centred=True)), load_scene(path))


@pytest.mark.parametrize("scale", [None, 0.25])
def test_applied_transform_and_scale_are_undone(demo, tmp_path, scale):
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    applied = np.concatenate([turn, [[0.3], [-0.4], [2.0]]], axis=1)
    path = write_nerfstudio(demo, tmp_path / "scene", applied)
    if scale is not None:

        def change(data):
            data["applied_scale"] = scale
            for frame in data["frames"]:
                for row in frame["transform_matrix"][:3]:
                    row[3] *= scale

        edit(path, change)
        points = reconstruction_of(demo).points3D
        positions = scale * (np.array([points[i].xyz for i in sorted(points)]) @ turn.T + applied[:, 3])
        write_points(path / "sparse_pc.ply", positions, np.array([points[i].color for i in sorted(points)]))
    scene, reference = load_scene(path), load_scene(demo)
    assert_same_cameras(scene, reference)
    torch.testing.assert_close(scene.points, reference.points, rtol=0, atol=1e-5)


def test_points_that_were_left_in_the_original_world_are_noticed(demo, tmp_path):
    path = write_nerfstudio(demo, tmp_path / "scene")
    reference = load_scene(demo)
    seen = reference.track_lengths >= 4  # hidden points have the colours of others in any case
    write_points(path / "sparse_pc.ply", reference.points[seen].double().numpy(), reference.colors[seen].numpy())
    with pytest.warns(UserWarning, match=r"sparse_pc.ply: its points fit the photos only without applied_transform"):
        scene = load_scene(path)
    torch.testing.assert_close(scene.points, reference.points[seen])


def test_lists_of_file_names_make_the_split(demo, tmp_path):
    def change(data):
        names = sorted(frame["file_path"] for frame in data["frames"])
        data |= {"train_filenames": names[:4], "val_filenames": names[4:6], "test_filenames": names[6:7]}

    path = edit(write_nerfstudio(demo, tmp_path / "scene"), change)
    scene = load_scene(path)
    assert [v.name for v in scene.train] == [f"view_00{i}.png" for i in range(4)]
    assert [v.name for v in scene.test] == ["view_006.png"]
    edit(path, lambda data: data["test_filenames"].clear())
    assert [v.name for v in load_scene(path).test] == ["view_004.png", "view_005.png"]
    edit(path, lambda data: data.update(val_filenames=data["train_filenames"][:1]))
    with pytest.warns(UserWarning, match="1 photos are listed for training and testing; they are used for testing"):
        scene = load_scene(path)
    assert [v.name for v in scene.test] == ["view_000.png"] and len(scene.train) == 3


def test_another_folder_of_photos_stands_in(demo, tmp_path):
    path = write_nerfstudio(demo, tmp_path / "scene")
    (path / "images_2").mkdir()
    for file in (path / "images").iterdir():
        Image.open(file).resize((48, 36)).save(path / "images_2" / file.name)
    full, half = load_scene(path), load_scene(path, images="images_2")
    for one, other in zip(views_of(full), views_of(half), strict=True):
        assert other.image.shape == (36, 48, 3) and one.name == other.name
        torch.testing.assert_close(project(other.camera, full.points), project(one.camera, full.points) / 2)


def test_blender_validates_on_val_where_there_is_no_test(demo, tmp_path):
    path = write_blender(demo, tmp_path / "scene")
    (path / "transforms_test.json").rename(path / "transforms_val.json")
    assert [v.name for v in load_scene(path).test] == ["test/view_000.png", "test/view_008.png"]
    (path / "transforms_val.json").unlink()
    scene = load_scene(path)
    assert [v.name for v in scene.test] == ["train/view_001.png"] and len(scene.train) == 7


def test_formats_are_told_apart(demo, tmp_path):
    colmap = make_scene(tmp_path / "colmap")
    assert find_format(demo) == find_format(colmap) == "colmap"
    both = write_nerfstudio(demo, tmp_path / "both")
    assert find_format(both) == "nerfstudio"
    (both / "sparse").mkdir()
    (both / "sparse" / "cameras.txt").write_text("")
    with pytest.raises(ValueError, match=r"got a COLMAP model and transforms.json; choose with format: colmap or nerf"):
        load_scene(both)
    assert len(load_scene(both, format="nerfstudio").train) == 8
    with pytest.raises(FileNotFoundError, match="incomplete COLMAP model"):
        load_scene(both, format="colmap")
    with pytest.raises(ValueError, match="format: expected one of colmap, nerfstudio, blender, got 'obj'"):
        load_scene(both, format="obj")
