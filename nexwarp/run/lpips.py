"""LPIPS 0.1 of VGG-16 (Zhang et al., CVPR 2018), with weights from a file: neither torchvision nor a download."""

import os
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch.nn.functional import conv2d, max_pool2d, normalize

from nexwarp.errors import FormatError
from nexwarp.io.files import check_tensors_header

# Convolutions of torchvision's `features` in five blocks; LPIPS compares what leaves each of them.
BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of ImageNet's colours, for inputs in [-1, 1]


def weights_file() -> Path:
    """Return the file of the weights: $NEXWARP_LPIPS, else lpips/vgg16.safetensors in the user's cache folder."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(os.environ.get("NEXWARP_LPIPS") or cache / "nexwarp" / "lpips" / "vgg16.safetensors")


class VGG(torch.nn.Module):
    """Distances of features that VGG-16 computes of two pictures."""

    def __init__(self, weights: dict[str, torch.Tensor]) -> None:
        """Take `0.weight`, `0.bias` ... `28.bias` of torchvision's features, and the heads `lin0` ... `lin4`."""
        super().__init__()
        self.weights = {name: values.float() for name, values in weights.items()}

    def forward(self, image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the distance, a scalar, of two (H, W, 3) pictures.

        The values go in as they are. The paper and 3DGS pass [0, 1], LPIPS's authors [-1, 1].
        """
        pictures = torch.stack([image, target]).permute(0, 3, 1, 2).float()
        shift, scale = (pictures.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        features, distance = (pictures - shift) / scale, pictures.new_zeros(())
        for block, layers in enumerate(BLOCKS):
            if block > 0:
                features = max_pool2d(features, 2)
            for layer in layers:
                weight, bias = (self.weights[f"{layer}.{name}"].to(features.device) for name in ("weight", "bias"))
                features = conv2d(features, weight, bias, padding=1).relu()
            first, second = normalize(features, eps=1e-10)
            head = self.weights[f"lin{block}"].to(features.device)
            distance = distance + ((first - second).square() * head[:, None, None]).sum(0).mean()
        return distance


def load_vgg(file: Path) -> VGG:
    """Read the network from a file of `python -m benchmarks.lpips_weights`."""
    try:
        check_tensors_header(file)
        weights = load_file(file)
    except SafetensorError as error:
        raise FormatError(f"{file}: damaged, {error}") from None
    expected = {f"{layer}.{name}" for layers in BLOCKS for layer in layers for name in ("weight", "bias")}
    expected |= {f"lin{block}" for block in range(len(BLOCKS))}
    if missing := sorted(expected - weights.keys()):
        raise FormatError(f"{file}: expected the weights of LPIPS with VGG-16, {missing[0]} is missing")
    return VGG(weights)
