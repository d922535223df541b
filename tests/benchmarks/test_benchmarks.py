import json
from pathlib import Path

from benchmarks import __main__ as command
from benchmarks.gpu_time import busy
from benchmarks.timing import Measurement


def test_the_command_writes_a_measurement_a_line(tmp_path: Path) -> None:
    out = tmp_path / "figures.json"
    assert command.main(["--quick", "--device", "cpu", "--only", "collect", "--out", str(out)]) == 0
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert len(lines) == 4 and all(line.keys() == Measurement.__dataclass_fields__.keys() for line in lines)
    assert all(0 < line["p10"] <= line["median"] <= line["p90"] for line in lines)


def test_time_of_a_gpu_counts_kernels_side_by_side_once_and_gaps_never() -> None:
    assert busy([(5.0, 7.0), (0.0, 2.0), (1.0, 3.0), (5.5, 6.0)]) == 5.0 and busy([]) == 0.0
