"""Writers of the demo: smaller, in each input format, and through distorted lenses."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

from nexwarp.data import Scene, View, load_scene
from nexwarp.data.lens import Lens, pycolmap_module
from nexwarp.data.scene import demo_folder
from nexwarp.io.pictures import save_png, to_uint8

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# As nerfstudio turns a COLMAP world: z up.
APPLIED = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
BARREL = (-0.16, 0.03, 0.001, -0.0007)  # k1, k2, p1, p2
FISHEYE = (0.03, -0.01, 0.004, -0.001)  # k1 to k4


def demo_lens(demo: Path, model: str, coefficients: tuple[float, ...]) -> Lens:
    """The demo's camera with a distorted lens in front of it."""
    camera = reconstruction_of(demo).camera(1)
    return Lens(model, (*map(float, camera.params), *coefficients), camera.width, camera.height)


def reconstruction_of(scene: Path):
    return pycolmap_module().Reconstruction(str(scene / "sparse" / "0"))


def write_demo(folder: str | Path, width: int, height: int, views: int, points: int) -> Path:
    """Write a smaller copy of the demo: `views` of its photos, reduced to PNG files, and at most `points` points."""
    folder = Path(folder)
    pycolmap = pycolmap_module()
    whole = reconstruction_of(demo_folder())
    camera = whole.camera(1)
    scale = np.array([width / camera.width, height / camera.height])
    camera.rescale(width, height)
    small = pycolmap.Reconstruction()
    small.add_camera_with_trivial_rig(camera)
    every = sorted(whole.reg_image_ids(), key=lambda number: whole.image(number).name)
    chosen = [every[int(index)] for index in np.linspace(0, len(every), views, endpoint=False)]
    keypoints: dict[int, list[np.ndarray]] = {number: [] for number in chosen}
    kept: list[tuple[Any, Any]] = []  # points and their tracks
    for _, point in sorted(whole.points3D.items()):
        seen = [element for element in point.track.elements if element.image_id in keypoints]
        if len(seen) >= 2 and len(kept) < points:
            track = pycolmap.Track()
            for element in seen:
                track.add_element(element.image_id, len(keypoints[element.image_id]))
                keypoints[element.image_id].append(whole.image(element.image_id).points2D[element.point2D_idx].xy)
            kept.append((point, track))
    (folder / "images").mkdir(parents=True)
    (folder / "sparse" / "0").mkdir(parents=True)
    for index, number in enumerate(chosen):
        pixels = np.array(keypoints[number]).reshape(-1, 2) * scale
        image = pycolmap.Image(name=f"view_{index:03d}.png", keypoints=pixels, camera_id=1, image_id=number)
        small.add_image_with_trivial_frame(image, whole.image(number).cam_from_world())
        with Image.open(demo_folder() / "images" / whole.image(number).name) as photo:
            photo.resize((width, height), Image.Resampling.BOX).save(folder / "images" / image.name)
    for point, track in kept:
        small.add_point3D(point.xyz, track, point.color)
    small.update_point_3d_errors()
    small.write_binary(str(folder / "sparse" / "0"))
    return folder


def photograph(photo: np.ndarray, pinhole: Lens, lens: Lens, samples: int = 3) -> np.ndarray:
    """(H, W, 3) uint8 of a wall that shows `photo`, which `pinhole` took, and goes on with its edges' colours."""
    x, y = ((np.arange(side * samples) + 0.5) / samples for side in (lens.width, lens.height))
    column, row = pinhole.project(lens.unproject(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))).T - 0.5
    channels = np.moveaxis(photo.astype(np.float64), -1, 0)
    planes = [map_coordinates(channel, (row, column), order=1, mode="nearest") for channel in channels]
    fine = np.stack(planes, axis=-1).reshape(lens.height, samples, lens.width, samples, 3)
    return np.floor(fine.mean(axis=(1, 3)) + 0.5).astype(np.uint8)


def write_distorted(demo: Path, folder: Path, lens: Lens) -> Path:
    """Write the demo as a COLMAP scene whose photos are taken through `lens`."""
    model = reconstruction_of(demo)
    camera = model.camera(1)
    pinhole = demo_lens(demo, "PINHOLE", ())
    (folder / "images").mkdir(parents=True)
    for number in model.reg_image_ids():
        name = model.image(number).name
        photo = np.array(Image.open(demo / "images" / name))
        Image.fromarray(photograph(photo, pinhole, lens)).save(folder / "images" / name)
    camera.model = lens.model
    camera.params = list(lens.params)
    camera.width, camera.height = lens.width, lens.height
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(folder / "sparse" / "0"))
    return folder


def write_text(demo: Path, folder: Path) -> Path:
    shutil.copytree(demo / "images", folder / "images")
    (folder / "sparse" / "0").mkdir(parents=True)
    reconstruction_of(demo).write_text(str(folder / "sparse" / "0"))
    return folder


def points_of(demo: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the demo's points (P, 3) and their colours (P, 3) uint8, by ascending id."""
    points = [point for _, point in sorted(reconstruction_of(demo).points3D.items())]
    return np.array([point.xyz for point in points]), np.array([point.color for point in points])


def write_points(path: Path, points: np.ndarray, colors: np.ndarray, form: str = "binary_little_endian") -> Path:
    """Write points (P, 3) and colours (P, 3) uint8 as doubles and bytes."""
    order = ">" if form.endswith("big_endian") else "<"
    header = f"ply\nformat {form} 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz")
    header += "".join(f"property uchar {color}\n" for color in ("red", "green", "blue")) + "end_header\n"
    vertices = np.empty(len(points), [(axis, f"{order}f8") for axis in "xyz"] + [(c, "u1") for c in "rgb"])
    for index in range(3):
        vertices["xyz"[index]], vertices["rgb"[index]] = points[:, index], colors[:, index]
    if form == "ascii":
        path.write_text(header + "".join(" ".join(f"{v!r}" for v in row) + "\n" for row in vertices.tolist()))
    else:
        path.write_bytes(header.encode() + vertices.tobytes())
    return path


def write_nerfstudio(demo: Path, folder: Path, applied: np.ndarray = APPLIED) -> Path:
    """Write a COLMAP scene of one camera as nerfstudio does, its world moved by `applied` (3, 4)."""
    model = reconstruction_of(demo)
    camera = model.camera(1)
    params = dict(zip([p.strip() for p in camera.params_info.split(",")], camera.params, strict=True))
    kind = "OPENCV" if camera.model.name == "PINHOLE" else camera.model.name
    data = {"camera_model": kind, "w": camera.width, "h": camera.height, "fl_x": params.pop("fx")}
    data |= {"fl_y": params.pop("fy"), **params, "applied_transform": applied.tolist()}
    data |= {"ply_file_path": "sparse_pc.ply", "frames": []}
    moved = np.vstack([applied, [0, 0, 0, 1]])
    for index in model.reg_image_ids():
        image = model.image(index)
        pose = moved @ np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])) @ OPENGL
        frame = {"file_path": f"images/{image.name}", "transform_matrix": pose.tolist(), "colmap_im_id": index}
        data["frames"].append(frame)
    folder.mkdir(parents=True)
    shutil.copytree(demo / "images", folder / "images")
    points, colors = points_of(demo)
    write_points(folder / "sparse_pc.ply", points @ applied[:, :3].T + applied[:, 3], colors)
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def write_blender(demo: Path, folder: Path, centred: bool = False, points: bool = True) -> Path:
    """Write a COLMAP scene of one camera as Blender's NeRF exports are, every eighth photo in the test file.

    The format has one angle, for square pixels and a centred image; without `centred` the intrinsics go into fl_x,
    fl_y, cx and cy. With `points` there is a points3d.ply.
    """
    model = reconstruction_of(demo)
    camera = model.camera(1)
    shared = {"camera_angle_x": 2 * np.arctan(0.5 * camera.width / camera.focal_length_x)}
    if not centred:
        fx, fy, cx, cy = camera.params
        shared |= {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "test": []}
    for index, identity in enumerate(sorted(model.reg_image_ids(), key=lambda i: model.image(i).name)):
        image = model.image(identity)
        split = "train" if index % 8 else "test"
        pose = np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])) @ OPENGL
        stem = Path(image.name).stem
        frame = {"file_path": f"./{split}/{stem}", "rotation": 0.01, "transform_matrix": pose.tolist()}
        frames[split].append({**frame, "colmap_im_id": identity})
        target = folder / split / image.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(demo / "images" / image.name, target)
    if points:
        write_points(folder / "points3d.ply", *points_of(demo))
    for split, listed in frames.items():
        (folder / f"transforms_{split}.json").write_text(json.dumps({**shared, "frames": listed}))
    return folder


def exposure_at(view: View) -> float:
    return 0.75 + 0.08 * view.camera.position[0].item()


def with_exposures(scene: Scene) -> Scene:
    """Return a scene whose photos grow brighter along the capture."""

    def exposed(views: list[View]) -> list[View]:
        return [dataclasses.replace(view, image=to_uint8(view.image / 255 * exposure_at(view))) for view in views]

    return dataclasses.replace(scene, train=exposed(scene.train), test=exposed(scene.test))


def expose_photos(folder: Path) -> None:
    """Make the photos of a scene grow brighter along the capture, in their PNG files."""
    scene = with_exposures(load_scene(folder))
    for view in (*scene.train, *scene.test):
        save_png(folder / "images" / view.name, view.image)
