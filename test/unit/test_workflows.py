"""Workflows of the forge run the project's own commands, on the versions that it supports."""

import os
import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
TARGETS = re.findall(r"^([a-z-]+)[a-z -]*:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def jobs():
    for path in WORKFLOWS:
        for name, job in yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"].items():
            yield pytest.param(job, id=f"{path.stem}-{name}")


def lines(job):
    """What the steps of a job run, with the values of its matrix."""
    texts = [step["run"] for step in job["steps"] if "run" in step]
    matrix = job.get("strategy", {}).get("matrix", {})
    return [line for text in texts for line in text.splitlines()] + matrix.get("command", [])


def test_there_are_workflows():
    assert {path.stem for path in WORKFLOWS} >= {"ci", "nightly", "benchmark", "release"}


@pytest.mark.parametrize("job", list(jobs()))
def test_commands_exist(job):
    for line in lines(job):
        for target in re.findall(r"\bmake ([a-z-]+)", line):
            assert target in TARGETS
        for script in re.findall(r"\S*\.ci/[a-z]+", line):
            assert os.access(ROOT / script.removeprefix("src/hand_eye_calib/"), os.X_OK)


@pytest.mark.parametrize("job", list(jobs()))
def test_jobs_end_and_leave_no_credentials(job):
    assert 5 <= job["timeout-minutes"] <= 120
    for step in job["steps"]:
        if step.get("uses", "").startswith("actions/checkout@"):
            assert step["with"]["persist-credentials"] is False


def test_what_ci_runs_here_runs_there():
    """Each step of .ci/run is a job of the workflow."""
    steps = re.findall(r"^step (make [a-z-]+)", (ROOT / ".ci" / "run").read_text(), re.MULTILINE)
    assert steps
    ci = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    run = {line for job in ci["jobs"].values() for line in lines(job)}
    assert set(steps) <= run


def test_every_declared_python_is_tested():
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    declared = re.findall(r"Programming Language :: Python :: (3\.\d+)", setup)
    ci = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    assert ci["jobs"]["test"]["strategy"]["matrix"]["python"] == declared
    assert f'python_requires=">={declared[0]}"' in setup
