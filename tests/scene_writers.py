"""Writers of the demo in each input format: COLMAP text, nerfstudio, Blender, and through distorted lenses."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from nexwarp.data.capture import Cloud
from nexwarp.data.demo_room import LAMP, build_room
from nexwarp.data.images import image_size
from nexwarp.data.lens import Lens, pycolmap_module
from nexwarp.data.ply import write_ply
from nexwarp.data.raytrace import first_hits, shade

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


def photograph(room, viewmat: np.ndarray, lens: Lens, samples: int = 4) -> np.ndarray:
    """(H, W, 3) uint8 of the demo's room, each pixel the mean of samples x samples distorted rays."""
    x, y = ((np.arange(side * samples) + 0.5) / samples for side in (lens.width, lens.height))
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    rays = lens.unproject(pixels.reshape(-1, 2)).reshape(*pixels.shape[:2], 3)
    rotation = viewmat[:3, :3]
    start = -rotation.T @ viewmat[:3, 3]
    hits = first_hits(room, start, (rays @ rotation).astype(np.float32))
    fine = shade(room, hits, start, LAMP)
    mean = fine.reshape(lens.height, samples, lens.width, samples, 3).mean(axis=(1, 3))
    return np.floor(mean * 255.0 + 0.5).astype(np.uint8)


def write_distorted(demo: Path, folder: Path, lens: Lens, samples: int = 4) -> Path:
    """Write the demo as a COLMAP scene whose photos are taken through `lens`."""
    model = reconstruction_of(demo)
    camera = model.camera(1)
    camera.model = lens.model
    camera.params = list(lens.params)
    camera.width, camera.height = lens.width, lens.height
    images = [model.image(index) for index in model.reg_image_ids()]
    room = build_room(image_size(demo / "images" / images[0].name)[0])
    viewmats = [np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in images]
    (folder / "images").mkdir(parents=True)
    with ThreadPoolExecutor(2) as pool:
        photos = pool.map(lambda viewmat: photograph(room, viewmat, lens, samples), viewmats)
        for image, photo in zip(images, photos, strict=True):
            Image.fromarray(photo).save(folder / "images" / image.name)
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(folder / "sparse" / "0"))
    return folder


def write_text(demo: Path, folder: Path) -> Path:
    """Write a COLMAP scene with its model as text."""
    shutil.copytree(demo / "images", folder / "images")
    (folder / "sparse" / "0").mkdir(parents=True)
    reconstruction_of(demo).write_text(str(folder / "sparse" / "0"))
    return folder


def cloud_of(demo: Path) -> Cloud:
    """Return the demo's points with COLMAP's tracks and errors."""
    points = [point for _, point in sorted(reconstruction_of(demo).points3D.items())]
    pairs = {(element.image_id, index) for index, point in enumerate(points) for element in point.track.elements}
    return Cloud(
        np.array([point.xyz for point in points]),
        np.array([point.color for point in points]),
        np.array([point.track.length() for point in points], np.int32),
        np.array([point.error for point in points], np.float32),
        np.array(sorted(pairs), np.int64),
    )


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


def write_nerfstudio(demo: Path, folder: Path, applied: np.ndarray = APPLIED, tracks: bool = True) -> Path:
    """Write a COLMAP scene of one camera as nerfstudio does, its world moved by `applied` (3, 4).

    With `tracks` the points have COLMAP's tracks and errors, which nerfstudio's own exports lack.
    """
    model = reconstruction_of(demo)
    camera = model.camera(1)
    params = dict(zip([p.strip() for p in camera.params_info.split(",")], camera.params, strict=True))
    data = {
        "camera_model": "OPENCV" if camera.model.name == "PINHOLE" else camera.model.name,
        "w": camera.width,
        "h": camera.height,
        "fl_x": params.pop("fx"),
        "fl_y": params.pop("fy"),
        **params,
        "applied_transform": applied.tolist(),
        "ply_file_path": "sparse_pc.ply",
        "frames": [],
    }
    moved = np.vstack([applied, [0, 0, 0, 1]])
    for index in model.reg_image_ids():
        image = model.image(index)
        pose = moved @ np.linalg.inv(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])) @ OPENGL
        frame = {"file_path": f"images/{image.name}", "transform_matrix": pose.tolist(), "colmap_im_id": index}
        data["frames"].append(frame)
    folder.mkdir(parents=True)
    shutil.copytree(demo / "images", folder / "images")
    cloud = cloud_of(demo)
    positions = cloud.positions @ applied[:, :3].T + applied[:, 3]
    cloud = replace(cloud, positions=positions) if tracks else Cloud.of(positions, cloud.colors)
    write_ply(folder / "sparse_pc.ply", cloud)
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def write_blender(demo: Path, folder: Path, centred: bool = False, points: bool = True) -> Path:
    """Write a COLMAP scene of one camera as Blender's NeRF exports are, every eighth photo in the test file.

    The format has one angle, for square pixels and a centred image; without `centred` the intrinsics go into fl_x,
    fl_y, cx and cy. With `points` there is a points3d.ply with COLMAP's tracks and errors.
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
        write_ply(folder / "points3d.ply", cloud_of(demo))
    for split, listed in frames.items():
        (folder / f"transforms_{split}.json").write_text(json.dumps({**shared, "frames": listed}))
    return folder
