"""Meshes that were exported: read back, and sampled evenly."""

from pathlib import Path

import numpy as np


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
