"""Runs the quality benchmark's jobs in worker processes and appends their results to a file."""

import json
import os
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from threading import Thread
from typing import Any

from benchmarks.quality.jobs import TrainingJob, group_jobs
from benchmarks.quality.results import result_line
from benchmarks.quality.rows import Row
from benchmarks.quality.run import SharedStart, run_job, train_shared_start


@dataclass(frozen=True)
class Schedule:
    """How to run jobs.

    Attributes:
        rows: rows by name.
        data: folder of the scenes.
        out: file that each result is appended to as soon as it is known.
        workers: trainings at once.
        pictures: folder for photo, rendering and error of each test view.
        models: folder to keep the models in.
    """

    rows: Mapping[str, Row]
    data: Path
    out: Path
    workers: int = 1
    pictures: Path | None = None
    models: Path | None = None

    def run(self, jobs: Sequence[TrainingJob]) -> int:
        """Run the jobs; return the exit code: 1 when some failed, 130 when interrupted."""
        workers = ProcessPoolExecutor(self.workers, get_context("spawn"), initializer=_end_with_parent)
        with tempfile.TemporaryDirectory() as starts, workers as pool:
            try:
                failed = self._run_in(pool, jobs, Path(starts))
            except KeyboardInterrupt:
                for worker in active_children():  # else each would finish its training, and then those that wait
                    worker.terminate()
                print("interrupted: the same command does what is missing", file=sys.stderr)
                return 130
        return 1 if failed else 0

    def _run_in(self, pool: ProcessPoolExecutor, jobs: Sequence[TrainingJob], starts: Path) -> int:
        """Run the jobs in a pool; return how many failed."""
        failed = 0
        waiting: dict[Future[Any], Sequence[TrainingJob]] = {}
        for number, group in enumerate(group_jobs(jobs, self.rows)):
            if group.iterations:
                row, folder = self.rows[group.jobs[0].row], starts / str(number)
                future = pool.submit(train_shared_start, group.jobs, self.data, row, group.iterations, folder)
                waiting[future] = group.jobs
            else:
                waiting[self._submit(pool, group.jobs[0])] = group.jobs
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                members = waiting.pop(future)
                try:
                    result = future.result()
                except Exception as error:  # one failure must not lose the others' results
                    failed += len(members)
                    for job in members:
                        print(f"{job}: {type(error).__name__}: {error}", file=sys.stderr)
                    continue
                if isinstance(result, SharedStart):
                    waiting |= {self._submit(pool, job, result): [job] for job in members}
                    continue
                with self.out.open("a") as file:
                    file.write(json.dumps(result | {"jobs": self.workers}) + "\n")
                print(result_line(members[0], result), flush=True)
        return failed

    def _submit(self, pool: ProcessPoolExecutor, job: TrainingJob, start: SharedStart | None = None) -> Future[Any]:
        return pool.submit(run_job, job, self.data, self.rows[job.row], self.pictures, self.models, start)


def _end_with_parent() -> None:
    """End a worker with the command, however that ends; leave Ctrl-C in a terminal to the command."""

    def follow() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=follow, daemon=True).start()
