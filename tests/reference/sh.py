"""Real spherical harmonics up to degree 3, in the order and with the signs of 3D Gaussian splatting files."""

import torch


def basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Evaluate the basis at unit `directions` (..., 3): (..., (degree + 1)^2)."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def evaluate(coefficients: torch.Tensor, directions: torch.Tensor, degree: int) -> torch.Tensor:
    """Sum `coefficients` (..., C, 3) times the basis at `directions` (..., 3), up to `degree`: (..., 3)."""
    degree = min(degree, round(coefficients.shape[-2] ** 0.5) - 1)
    values = basis(directions, degree)
    return (values[..., None] * coefficients[..., : values.shape[-1], :]).sum(dim=-2)


def plain_colors(sh: torch.Tensor, means: torch.Tensor, camera_position: torch.Tensor, degree: int) -> torch.Tensor:
    """Plain colours (N, 3) of surfels `sh` (N, C, 3) seen from `camera_position` (3,)."""
    directions = torch.nn.functional.normalize(means - camera_position, dim=-1)
    return (0.5 + evaluate(sh, directions, degree)).clamp_min(0)
