"""Chamfer distance between the mesh of a run of the demo scene and the demo's own geometry.

    nexwarp train demo && nexwarp export runs/demo --format mesh
    python -m benchmarks.mesh runs/demo/export/mesh.ply --picture mesh.png

Accuracy is the distance from points of the mesh to the nearest rectangle of the scene, completeness that from the
points that the demo's cameras see to the mesh. A bad mesh has a large mean of one or the other; the chamfer distance is
the mean of both. The picture shows the mesh from a camera of the scene: colours and normals. A mesh of another scene
has no known geometry, and is only drawn:

    python -m benchmarks.mesh runs/fox/export/mesh.ply --picture mesh.png --run runs/fox --view 0001.jpg
"""

import argparse
from pathlib import Path

import numpy as np
import torch

import nexwarp as nw
from nexwarp.data.demo import HEIGHT, VIEWS, WIDTH, demo_cameras
from nexwarp.data.demo_room import build_room
from nexwarp.data.raytrace import Rectangle, first_hits

SAMPLES = 400_000  # points on the mesh
POINTS_A_PIXEL = 8  # of the picture of a mesh
PIXELS = 3  # every third pixel of the demo's cameras sees a point


def read_mesh(path: Path) -> dict[str, np.ndarray]:
    """Read what `nexwarp.export.mesh.save_mesh` writes: vertices, normals, colors and triangles."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    counts = [int(line.split()[2]) for line in data[:end].decode().splitlines() if line.startswith("element")]
    kinds = [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in ("r", "g", "b")]
    rows = np.frombuffer(data, kinds, counts[0], end)
    faces = np.frombuffer(data, [("count", "u1"), ("vertices", "<i4", 3)], counts[1], end + rows.nbytes)
    columns = {"vertices": ("x", "y", "z"), "normals": ("nx", "ny", "nz"), "colors": ("r", "g", "b")}
    mesh = {name: np.stack([rows[c] for c in names], 1) for name, names in columns.items()}
    return mesh | {"triangles": faces["vertices"]}


def sample(mesh: dict[str, np.ndarray], count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Draw points evenly over a mesh's area, with the colours and normals of its vertices."""
    rng = np.random.default_rng(seed)
    a, b, c = (mesh["vertices"][mesh["triangles"][:, i]].astype(float) for i in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    corners = mesh["triangles"][chosen]
    return {
        name: sum(w * mesh[name][corners[:, i]].astype(float) for i, w in enumerate((1 - u - v, u, v)))
        for name in ("vertices", "normals", "colors")
    }


def distance_to(rectangles: list[Rectangle], points: np.ndarray) -> np.ndarray:
    """Return the distance of points (N, 3) to the nearest of the rectangles."""
    nearest = np.full(len(points), np.inf)
    for r in rectangles:
        offset = points - r.origin
        a, b = (np.clip(offset @ e / (e @ e), 0, 1) for e in (r.u, r.v))
        nearest = np.minimum(nearest, np.linalg.norm(points - r.at(a, b), axis=1))
    return nearest


def seen_points(rectangles: list[Rectangle]) -> np.ndarray:
    """Return the points (N, 3) of the scene that its cameras see."""
    rig = demo_cameras(WIDTH, HEIGHT, VIEWS)
    rows, columns = np.mgrid[0 : rig.size[1] : PIXELS, 0 : rig.size[0] : PIXELS]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(rows.shape)], -1)
    points = []
    for viewmat in rig.viewmats:
        start = -viewmat[:3, :3].T @ viewmat[:3, 3]
        directions = pixels @ np.linalg.inv(rig.K).T @ viewmat[:3, :3]
        hits = first_hits(rectangles, start, directions)
        seen = hits.ids >= 0
        points.append(start + directions[seen] / hits.nearness[seen][:, None])
    return np.concatenate(points)


def draw(mesh: dict[str, np.ndarray], camera: nw.Camera, path: Path) -> None:
    """Write a picture of a mesh: its colours, and its normals in the camera's frame; dark where the back is seen."""
    from PIL import Image

    viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
    local = mesh["vertices"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    pixels = (local / np.maximum(local[:, 2:], camera.near)) @ K.T
    triangles = mesh["triangles"][(local[:, 2] > camera.near)[mesh["triangles"]].all(1)]
    corners = pixels[triangles, :2]
    seen = ((corners.max(1) >= 0) & (corners.min(1) < (camera.width, camera.height))).all(1)
    triangles, corners = triangles[seen], corners[seen]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2  # pixels; below 0 where counter-clockwise, y being down
    counts = np.ceil(np.minimum(np.abs(area), camera.width * camera.height) * POINTS_A_PIXEL).astype(int)
    chosen = np.repeat(np.arange(len(triangles)), counts)
    u, v = np.random.default_rng(0).random((2, len(chosen), 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    weights = (1 - u - v, u, v)
    depth = sum(w[:, 0] * local[triangles[chosen, k], 2] for k, w in enumerate(weights))
    place = sum(w * corners[chosen, k] for k, w in enumerate(weights)).astype(int)
    inside = ((place >= 0) & (place < (camera.width, camera.height))).all(1)
    order = np.flatnonzero(inside)[np.argsort(-depth[inside])]  # far to near
    normals = 127.5 * (1 + mesh["normals"] @ viewmat[:3, :3].T)
    pictures = []
    for values in (mesh["colors"], normals):
        image = np.zeros((camera.height, camera.width, 3), np.uint8)
        drawn = sum(w[order] * values[triangles[chosen[order], k]] for k, w in enumerate(weights))
        drawn = drawn * np.where(area[chosen[order]] < 0, 1.0, 0.3)[:, None]
        image[place[order, 1], place[order, 0]] = np.clip(drawn, 0, 255).astype(np.uint8)
        pictures.append(image)
    Image.fromarray(np.concatenate(pictures, 1)).save(path)


def demo_camera(view: int = 3, factor: int = 3) -> nw.Camera:
    """Return a camera of the demo, with more pixels."""
    rig = demo_cameras(factor * WIDTH, factor * HEIGHT, VIEWS)
    return nw.Camera(torch.from_numpy(rig.viewmats[view]).float(), torch.from_numpy(rig.K).float(), *map(int, rig.size))


def chamfer(mesh: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the mean, median and 95th percentile of accuracy and completeness of a demo's mesh, and their mean."""
    from scipy.spatial import cKDTree

    room, points = build_room(16), sample(mesh, SAMPLES)
    found: dict[str, float] = {}
    accuracy = distance_to(room, points["vertices"])
    completeness = cKDTree(points["vertices"]).query(seen_points(room))[0]
    for name, values in (("accuracy", accuracy), ("completeness", completeness)):
        found |= {f"{name} mean": values.mean(), f"{name} median": np.median(values)}
        found |= {f"{name} 95 %": np.quantile(values, 0.95)}
    return found | {"chamfer distance": (accuracy.mean() + completeness.mean()) / 2}


def main() -> None:
    """Print the distances, and draw the mesh."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--run", type=Path, help="run folder of another scene, whose mesh is only drawn")
    parser.add_argument("--view", help="name of a photo of that run, whose camera draws; the first test view without")
    args = parser.parse_args()
    mesh = read_mesh(args.mesh)
    print(f"{len(mesh['vertices']):,} vertices, {len(mesh['triangles']):,} triangles")
    if args.run is None:
        for name, value in chamfer(mesh).items():
            print(f"{name}: {value:.4f} world units")
    if args.picture is not None:
        draw(mesh, demo_camera() if args.run is None else run_camera(args.run, args.view), args.picture)


def run_camera(run: Path, name: str | None) -> nw.Camera:
    """Return the camera of a photo of a run; of the first test view without a name."""
    groups = nw.load_cameras(run)
    cameras = groups.get("test", {}) | groups["train"]
    return cameras[name or next(iter(cameras))]


if __name__ == "__main__":
    main()
