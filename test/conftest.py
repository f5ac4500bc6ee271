"""What every test may use."""

import gc
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
from hypothesis import settings

from hand_eye_calib.offline.cli.main import main

# Tests never time anything, and CI must not differ from run to run.
settings.register_profile(
    "hand_eye_calib", deadline=None, derandomize=True, print_blob=True
)
settings.load_profile("hand_eye_calib")

# A shell starts what runs in the background with Ctrl-C ignored, and children inherit that: tests
# that send it would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """One more than processors: tests that start nodes mostly wait."""
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give each file to one worker, and all files whose tests start nodes to the same worker.

    Fixtures of a module are made once, and no two nodes compete for processor time.
    """
    from xdist.scheduler import LoadScopeScheduling

    class FileScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return (
                "test/ros"
                if nodeid.startswith("test/ros/")
                else nodeid.partition("::")[0]
            )

    return FileScheduling(config, log)


def pytest_collection_finish():
    """What is imported stays: the collector need not walk through it again and again."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _ros_stays_here(tmp_path_factory):
    """ROS talks on this machine and logs into pytest's temporary folder; so do subprocesses."""
    patch = pytest.MonkeyPatch()
    patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    patch.setenv("ROS_LOG_DIR", str(tmp_path_factory.mktemp("ros_log")))
    yield
    patch.undo()


@pytest.fixture
def run(capsys):
    """Runs a command in this process; returns exit code, stdout and stderr."""

    def call(*arguments):
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as end:
            code = end.code
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def no_processes(monkeypatch):
    """Several recordings are calibrated in threads: each process would import for a second."""
    monkeypatch.setattr(
        "hand_eye_calib.extras.fleet.work._processes", ThreadPoolExecutor
    )


@pytest.fixture
def no_figures(monkeypatch):
    """Reports of this process have no figures: drawing takes several times as long as the solve."""
    monkeypatch.setattr(
        "hand_eye_calib.offline.report.report.figures_of", lambda *_: []
    )


@pytest.fixture
def refused(run):
    """Run a command that must end in one line on stderr, nothing on stdout; returns the line."""

    def call(*arguments, code=1):
        exit_code, out, err = run(*arguments)
        assert (exit_code, out) == (code, "")
        lines = [
            line
            for line in err.splitlines()
            if not line.startswith("hand_eye_calib: note: ")
        ]
        assert len(lines) == 1, err
        assert lines[0].startswith("hand_eye_calib: error: ")
        return lines[0]

    return call
