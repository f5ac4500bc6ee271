"""No command runs Python files that lie in the folder where it is called."""

import os
import subprocess
import sys

import pytest
from source_code import SOURCE

from hand_eye_calib.core.base.python_path import starting_trusted

# Modules of the standard library that the commands and their processes import late.
STRANGERS = (
    "queue.py",
    "bisect.py",
    "csv.py",
    "heapq.py",
    "multiprocessing.py",
    "numpy.py",
)
# As pip installs it: Python looks for modules beside this file first.
PROGRAM = """
from hand_eye_calib.offline.cli.main import main
if __name__ == "__main__":
    raise SystemExit(main())
"""
SOLVER = """
from hand_eye_calib.online.live.solving import SolvingProcess
process = SolvingProcess(lambda: None, "import queue, csv, bisect; raise SystemExit(7)")
print(process._process.wait())
process._process.communicate()
"""


@pytest.fixture
def hostile_folder(tmp_path):
    """A folder with modules named as those of the standard library, which leave a mark."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for name in STRANGERS:
        (folder / name).write_text(
            "open('executed', 'a').write(__name__)\nraise SystemExit(99)\n"
        )
    return folder


def run(arguments, folder, **environment):
    """Run the interpreter in a folder, as an installed program does: the package is found there."""
    root = str(SOURCE.parent)
    environment = {**os.environ, "PYTHONPATH": root, **environment}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True
    )


@pytest.fixture
def program(tmp_path):
    """The command as a file of its own folder."""
    path = tmp_path / "bin" / "hand_eye_calib"
    path.parent.mkdir()
    path.write_text(PROGRAM)
    return str(path)


@pytest.fixture
def bags(tmp_path, program):
    simulate = [
        "simulate",
        "--runs",
        "2",
        "--bag",
        "mcap",
        "--out",
        str(tmp_path / "drives"),
    ]
    done = run([program, *simulate], tmp_path)
    assert done.returncode == 0, done.stderr
    return sorted((tmp_path / "drives").rglob("*.mcap"))


def test_workers_of_a_batch_run_no_file_of_the_current_folder(
    hostile_folder, bags, program
):
    out = hostile_folder.parent / "out"
    batch = [
        "calibrate",
        "--batch",
        *map(str, bags),
        "--jobs",
        "2",
        "--out",
        str(out),
    ]
    done = run([program, *batch], hostile_folder)
    assert not (hostile_folder / "executed").exists(), done.stderr
    assert len((out / "rows.csv").read_text().splitlines()) == 3


def test_the_solving_process_runs_no_file_of_the_current_folder(
    hostile_folder, tmp_path
):
    solver = tmp_path / "solver.py"
    solver.write_text(SOLVER)
    done = run([str(solver)], hostile_folder)
    assert done.stdout.split() == ["7"], done.stderr
    assert not (hostile_folder / "executed").exists()


def test_python_m_runs_no_file_of_the_current_folder_once_the_package_runs(
    hostile_folder, bags
):
    # Before that, `python -m` itself has the current folder first.
    for name in STRANGERS:
        if name != "numpy.py":
            (hostile_folder / name).unlink()
    done = run(
        ["-m", "hand_eye_calib", "calibrate", str(bags[0])], hostile_folder
    )
    assert done.returncode in (0, 3), done.stderr
    assert not (hostile_folder / "executed").exists()


@pytest.mark.parametrize("before", [None, "/somewhere"])
def test_the_environment_of_the_program_is_put_back(monkeypatch, before):
    if before is None:
        monkeypatch.delenv("PYTHONPATH", raising=False)
    else:
        monkeypatch.setenv("PYTHONPATH", before)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with starting_trusted():
        assert os.environ["PYTHONSAFEPATH"] == "1"
        assert os.environ["PYTHONPATH"] != before
    assert os.environ.get("PYTHONPATH") == before
    assert "PYTHONSAFEPATH" not in os.environ
