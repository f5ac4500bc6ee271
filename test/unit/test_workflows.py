"""Workflows of the forge run the project's own commands, on the versions that it supports."""

import os
import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = {
    path.stem: yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    for path in (ROOT / ".github" / "workflows").glob("*.yml")
}


def lines(jobs):
    """What the steps of jobs run, with the values of their matrices."""
    steps = [step for job in jobs.values() for step in job["steps"]]
    found = [line for step in steps for line in step.get("run", "").splitlines()]
    matrices = [job.get("strategy", {}).get("matrix", {}) for job in jobs.values()]
    return found + [line for matrix in matrices for line in matrix.get("command", [])]


def test_commands_exist_jobs_end_and_leave_no_credentials():
    assert WORKFLOWS.keys() >= {"ci", "nightly", "benchmark", "release"}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z-]+)[a-z -]*:", makefile, re.MULTILINE)
    for jobs in WORKFLOWS.values():
        said = "\n".join(lines(jobs))
        assert set(re.findall(r"\bmake ([a-z-]+)", said)) <= set(targets)
        for script in re.findall(r"\S*\.ci/[a-z]+", said):
            assert os.access(ROOT / script.removeprefix("src/hand_eye_calib/"), os.X_OK)
        for job in jobs.values():
            assert 5 <= job["timeout-minutes"] <= 120
            for step in job["steps"]:
                if step.get("uses", "").startswith("actions/checkout@"):
                    assert step["with"]["persist-credentials"] is False


def test_what_ci_runs_here_runs_there_and_on_every_declared_python():
    """Each step of .ci/run is a job of the workflow."""
    steps = re.findall(r"^step (make [a-z-]+)", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert len(steps) >= 4
    assert set(steps) <= set(lines(WORKFLOWS["ci"]))
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    declared = re.findall(r"Programming Language :: Python :: (3\.\d+)", setup)
    assert WORKFLOWS["ci"]["test"]["strategy"]["matrix"]["python"] == declared
    assert f'python_requires=">={declared[0]}"' in setup
