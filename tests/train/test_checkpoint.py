import os
import random
from pathlib import Path

import pytest
import torch

from nexwarp.train.checkpoint import CHECKPOINTS, _read_checkpoint, load_checkpoint, save_checkpoint
from tests.tolerances import assert_equal


def save_number(run: Path, number: int) -> None:
    save_checkpoint(run, {"x": torch.full((3,), float(number))}, {"iteration": number})


def kept(run: Path) -> list[int]:
    """Iterations of the checkpoints there are, the newest first; each is whole, and there is nothing else."""
    assert sorted(os.listdir(run)) == list(CHECKPOINTS[: len(os.listdir(run))])
    return [_read_checkpoint(run / name)[1]["iteration"] for name in CHECKPOINTS if (run / name).exists()]


def test_checkpoint_round_trip(tmp_path):
    tensors = {"float": torch.randn(5, 0, 3), "scalar": torch.tensor(7.0), "bytes": torch.get_rng_state()}
    tensors["strided"] = torch.randn(4, 6).T
    state = {"iteration": 3, "order": [2, 0, 1], "python": [3, [1, 2], None], "seconds": 0.1}
    save_checkpoint(tmp_path, tensors, state)
    loaded, again = load_checkpoint(tmp_path)
    assert again == state
    assert_equal(loaded, tensors)
    save_number(tmp_path, 4)
    tensors, state = load_checkpoint(tmp_path)
    assert tensors["x"].tolist() == [4.0] * 3 and state == {"iteration": 4} and kept(tmp_path) == [4, 3]


@pytest.mark.parametrize("name", ["tensors.safetensors", "state.json"])
def test_every_flipped_bit_and_every_length_is_found(tmp_path, name):
    """What is read is what was written, or the checkpoint before; never anything else."""
    save_number(tmp_path, 1)
    save_number(tmp_path, 2)
    file = tmp_path / "checkpoint" / name
    content = file.read_bytes()
    generator = random.Random(0)
    damaged = [content[:length] for length in range(len(content))]
    for place in range(len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << generator.randrange(8)
        damaged.append(bytes(flipped))
    told: list[str] = []
    for bad in damaged:
        file.write_bytes(bad)
        told.clear()
        tensors, state = load_checkpoint(tmp_path, told.append)
        if told:
            assert state == {"iteration": 1} and tensors["x"].tolist() == [1.0] * 3
            assert told[0].startswith(f"{file.parent}: expected a whole checkpoint") and "\n" not in told[0]
        else:  # a flip in white space
            assert name == "state.json" and state == {"iteration": 2}, bad
    file.write_bytes(content + b"\0")
    assert load_checkpoint(tmp_path)[1] == {"iteration": 1}
