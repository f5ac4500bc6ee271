"""Workers of a batch that die, or whose batch is killed."""

import contextlib
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fleet_making import always_dies, dies_once

from hand_eye_calib.extras.fleet.work import Task, outcomes


def some_tasks(*names, **options):
    return [
        Task(name=name, bags=(), options=options.get(name, {}))
        for name in names
    ]


def done_by(tasks, work, **where):
    return {
        task.name: outcome.row["error"]
        for task, outcome in outcomes(tasks, 2, do=work, **where)
    }


NAMES = ("a", "b", "c", "d", "bad")


def test_what_a_worker_that_dies_had_to_do_is_done_again(tmp_path):
    tasks = some_tasks(*NAMES, b={"marker": str(tmp_path / "marker")})
    assert done_by(tasks, dies_once) == dict.fromkeys(NAMES, "done")
    assert (tmp_path / "marker").exists()


def test_a_recording_of_which_workers_die_takes_no_other_along():
    errors = done_by(some_tasks(*NAMES), always_dies)
    assert (
        errors.pop("bad")
        == "worker processes crash on it, perhaps for lack of memory: use --jobs 1"
    )
    assert errors == dict.fromkeys(NAMES[:-1], "done")


def ended(pidfd, within_s=120):
    """Wait for a process to end."""
    return bool(select.select([pidfd], [], [], within_s)[0])


@pytest.mark.skipif(
    not hasattr(os, "pidfd_open"),
    reason="processes are awaited by Linux's pidfd",
)
def test_no_worker_outlives_a_batch_that_is_killed(tmp_path):
    code = (
        "from fleet_making import never_ends; from hand_eye_calib.extras.fleet.work import Task\n"
        "from hand_eye_calib.extras.fleet.work import outcomes\n"
        "if __name__ == '__main__':\n"
        "    tasks = [Task(name=name, bags=(), options={'pipe': PIPE}) for name in 'ab']\n"
        "    list(outcomes(tasks, 2, do=never_ends))\n"
    )
    pipe = tmp_path / "pids"
    os.mkfifo(pipe)
    script = tmp_path / "batch.py"
    script.write_text(code.replace("PIPE", repr(str(pipe))))
    paths = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    with subprocess.Popen(
        [sys.executable, script], env=os.environ | {"PYTHONPATH": paths}
    ) as batch:
        # Open for writing too: the pipe has no end between the lines of the workers.
        with pipe.open("r+b", buffering=0) as lines:
            workers = [os.pidfd_open(int(lines.readline())) for _ in range(2)]
        batch.kill()
    try:
        assert [ended(worker) for worker in workers] == [True, True]
    finally:
        for worker in workers:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(worker, signal.SIGKILL)
            os.close(worker)
