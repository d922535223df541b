"""Memory stays as it is over frames and steps; `python -m tests.robustness.soak` goes on for longer."""

import mmap
import threading

import pytest
import torch

from nexwarp.train.trainer import Trainer
from tests.robustness import soak
from tests.robustness.soak import (
    EVERYONES,
    MemorySample,
    Soak,
    cycle,
    handles,
    judge,
    library_calls,
    memory,
    phase,
    spans,
)
from tests.trainer_support import small

MIB = 2**20


def series(values, name="host"):
    return [(number, {name: int(value)}) for number, value in enumerate(values, 1)]


def test_spans_are_the_first_and_the_last_thousand_after_a_warm_up():
    assert spans(20_000) == (range(501, 1501), range(19_001, 20_001))
    assert spans(5_000) == (range(501, 1501), range(4_001, 5_001))
    for count in (1, 2, 3, 10, 100, 500, 2000):
        first, last = spans(count)
        assert len(first) == len(last) >= 1 and first[0] >= 1 and last[-1] == count
        assert first.start <= last.start
        if count > 3:
            assert set(first).isdisjoint(last) and first.start > min(count // 5, 500)


@pytest.mark.parametrize(
    ("values", "flat"),
    [
        ([500 * MIB] * 5000, True),
        ([100 * MIB + 200 * MIB * min(i, 400) // 400 for i in range(5000)], True),  # grows in the warm-up alone
        ([500 * MIB + i % 7 * 9 * MIB for i in range(5000)], True),  # goes up and down
        ([500 * MIB + 1000 * i for i in range(5000)], True),  # 3.3 MiB in all: within 1 %
        ([500 * MIB + 2000 * i for i in range(5000)], False),  # a leak of 2 kB a frame
        ([500 * MIB - 2000 * i for i in range(5000)], False),
        ([500 * MIB] * 3000 + [506 * MIB] * 2000, False),
        ([0] * 5000, True),
        ([0] * 3000 + [MIB] * 2000, False),
        ([MIB] * 3000 + [MIB + 2**17] * 2000, True),  # pieces of something small
    ],
)
def test_growth_is_told_from_ups_and_downs(values, flat):
    (verdict,) = judge(series(values), len(values))
    assert verdict.flat == flat, verdict


def test_verdicts_tell_figures_by_kind():
    samples = [(i, {"host": 100 * MIB, "GPU used": (100 + (i > 900)) * 10 * MIB}) for i in range(10, 1010, 10)]
    host, gpu = judge(samples, 1000)
    assert (host.name, host.flat, host.change) == ("host", True, 0.0)
    assert gpu.name == "GPU used" and gpu.first == 1000 * MIB and gpu.last > gpu.first
    assert gpu.change == pytest.approx((gpu.last - gpu.first) / gpu.first)
    with pytest.raises(ValueError, match="samples: expected some in"):
        judge(samples[:40], 1000)


def test_a_leak_fails_the_command(monkeypatch, capsys):
    """Nothing is rendered: the judge is handed a memory that grows."""
    grown = iter(range(10**6))
    monkeypatch.setattr(soak, "memory", lambda _: {"host": 100 * MIB + 2**16 * next(grown)})
    monkeypatch.setattr(
        soak, "render_frames", lambda trainer, cameras, count, sample: [sample(i + 1) for i in range(count)]
    )
    assert Soak(device="cpu", frames=100, steps=0, max_surfels=50, width=24)() == 1
    out = capsys.readouterr().out
    assert "NOT FLAT" in out and "frames, host: " in out and "MiB in 26 to 62 and 64 to 100" in out


def test_memory_is_seen(device):
    before = memory(device)
    kept: object
    if device.type == "cpu":  # from the system: the heap may have had room
        mapped = mmap.mmap(-1, 64 * MIB)
        mapped.write(bytes(64 * MIB))
        kept = mapped
    else:
        kept = torch.ones(64 * MIB // 4, device=device)
    after = memory(device)
    kind = "host" if device.type == "cpu" else "torch allocated"
    assert after[kind] - before[kind] > 60 * MIB
    del kept


def test_frames_and_steps_leave_memory_as_it_is(device, capsys):
    assert Soak(device=device.type, frames=500, steps=80, max_surfels=150, width=32)() == 0, capsys.readouterr().out
    out = capsys.readouterr().out
    assert "8 rounds of density control" in out and "flat: first and last are within 1 % throughout" in out
    assert out.count(": flat") == 2 * len(memory(device).keys() - {EVERYONES})


@pytest.mark.slow
@pytest.mark.parametrize("count", [2000])
def test_loads_and_renderings_leave_nothing_behind(tiny_scene, tmp_path, device, count):
    """Neither memory nor open files nor threads, over renderings of 84 cameras with and without gradients."""
    trainer = Trainer(tiny_scene, small(max_surfels=60), device)
    trainer.run(until=3)
    file = trainer.finish().save(tmp_path / "model.safetensors")
    del trainer
    samples: list[MemorySample] = []
    kept: list[dict[str, int]] = []

    def sample(number: int) -> None:
        if number % 20 == 0:
            samples.append((number, memory(device)))
            kept.append(handles())

    library_calls(file, cycle(tiny_scene, device, 0), count, sample, device)
    assert phase(f"loads and renderings on {device}", count, samples)
    assert kept[-1] == kept[len(kept) // 4], (kept[len(kept) // 4], kept[-1])
    print(kept[-1])


def test_open_files_and_threads_are_seen(tmp_path):
    before = handles()
    stop = threading.Event()
    thread = threading.Thread(target=stop.wait)
    thread.start()
    with open(tmp_path / "file", "w"):
        assert handles() == {name: number + 1 for name, number in before.items()}
    stop.set()
    thread.join()


def test_library_calls_are_of_all_kinds(tiny_scene, tmp_path, device):
    trainer = Trainer(tiny_scene, small(max_surfels=60), device)
    file = trainer.model().save(tmp_path / "model.safetensors")
    numbers: list[int] = []
    library_calls(file, cycle(tiny_scene, device, 0), 6, numbers.append, device)
    assert numbers == [1, 2, 3, 4, 5, 6]
