"""How viewers of 3D Gaussian splatting draw: each Gaussian projected by the derivative of the projection at its centre.

With the defaults of gsplat's rasterization: 0.3 pixel^2 of blur, the derivative taken at most 15 % of the image beyond
its edge, hits of alpha below 1/255 left out, others capped at 0.999.
"""

import torch

from tests.reference.collect import rotations

BLUR, ALPHA_MIN, ALPHA_MAX, MARGIN = 0.3, 1 / 255, 0.999, 0.3


def render(means, quats, scales, opacities, colors, camera, background, blur=BLUR) -> torch.Tensor:
    """(H, W, 3) float64 of Gaussians (N, 3), (N, 4) wxyz, (N, 3), (N,) with colours (N, 3)."""
    viewmat, K = camera.viewmat.double(), camera.K.double()
    centres = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y, z = centres.unbind(1)
    half = MARGIN * 0.5 * torch.tensor([camera.width, camera.height]) / K[[0, 1], [0, 1]]
    low = -K[:2, 2] / K[[0, 1], [0, 1]] - half
    high = (torch.tensor([camera.width, camera.height]) - K[:2, 2]) / K[[0, 1], [0, 1]] + half
    at = torch.minimum(torch.maximum(centres[:, :2] / z[:, None], low), high)
    zero = torch.zeros_like(z)
    rows = [[K[0, 0] / z, zero, -K[0, 0] * at[:, 0] / z], [zero, K[1, 1] / z, -K[1, 1] * at[:, 1] / z]]
    jacobian = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)
    spread = jacobian @ viewmat[:3, :3] @ (rotations(quats) * scales[:, None])
    inverse = torch.linalg.inv(spread @ spread.mT + blur * torch.eye(2, dtype=torch.float64))
    pixels = torch.stack([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]], dim=1)
    row, column = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    places = torch.stack([column, row], dim=-1).double()
    image, rest = torch.zeros(*row.shape, 3, dtype=torch.float64), torch.ones(row.shape, dtype=torch.float64)
    for i in z.argsort().tolist():
        if z[i] <= 0.01:
            continue
        apart = places - pixels[i]
        alpha = opacities[i] * torch.exp(-0.5 * ((apart @ inverse[i]) * apart).sum(-1))
        alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha.clamp(max=ALPHA_MAX))
        image += (rest * alpha)[..., None] * colors[i]
        rest = rest * (1 - alpha)
    return image + rest[..., None] * torch.tensor(background, dtype=torch.float64)
