"""Memory stays as it is over frames and steps; `python -m tests.robustness.soak` goes on for longer."""

import pytest

from nexwarp.train.trainer import Trainer
from tests.robustness.soak import MIB, Sampler, cycle, handles, judge, library_calls, memory, soak, spans
from tests.trainer_support import small


def test_spans_are_the_first_and_the_last_thousand_after_a_warm_up():
    assert spans(20_000) == (range(501, 1501), range(19_001, 20_001))
    for count in (1, 2, 3, 10, 100, 500, 2000):
        first, last = spans(count)
        assert len(first) == len(last) >= 1 and first[0] >= 1 and last[-1] == count
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
        ([0] * 3000 + [MIB] * 2000, False),
        ([MIB] * 3000 + [MIB + 2**17] * 2000, True),  # pieces of something small
    ],
)
def test_growth_is_told_from_ups_and_downs(values, flat):
    (verdict,) = judge([(number, {"host": value}) for number, value in enumerate(values, 1)], len(values))
    assert verdict.flat == flat, verdict


def test_frames_and_steps_leave_memory_as_it_is(device, capsys):
    assert soak(device, frames=500, steps=80), capsys.readouterr().out
    assert capsys.readouterr().out.count(": flat") == 2 * len(memory(device))


@pytest.mark.slow
def test_loads_and_renderings_leave_nothing_behind(tiny_scene, tmp_path, device):
    """Neither memory nor open files nor threads, over renderings of 84 cameras with and without gradients."""
    trainer = Trainer(tiny_scene, small(max_surfels=60), device)
    trainer.run(until=3)
    file = trainer.finish().save(tmp_path / "model.safetensors")
    del trainer
    count, samples, open_handles = 2000, Sampler(2000, device), []

    def sample(number: int) -> None:
        samples(number)
        open_handles.append(handles())

    library_calls(file, cycle(tiny_scene, device), count, sample, device)
    verdicts = judge(samples.taken, count)
    assert all(verdict.flat for verdict in verdicts), verdicts
    assert open_handles[-1] == open_handles[count // 4]
