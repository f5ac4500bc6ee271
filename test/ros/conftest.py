"""A node in a process of its own and a peer, on a ROS domain that nobody else uses."""

import os
import sys
from multiprocessing import forkserver
from pathlib import Path

import pytest
from ros_harness import NodeProcess, Peer, free_domain, release_domain


@pytest.fixture(scope="session", autouse=True)
def _quick_discovery():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(
            "FASTRTPS_DEFAULT_PROFILES_FILE",
            str(Path(__file__).with_name("discovery.xml")),
        )
        with pytest.MonkeyPatch.context() as path:
            # It imports what it is told to only from here, and fails in silence.
            path.setenv("PYTHONPATH", os.pathsep.join(sys.path))
            forkserver.ensure_running()
        yield
        forkserver._forkserver._stop()  # processor time counts when it is waited for


@pytest.fixture
def domain():
    reserved = free_domain()
    yield reserved
    release_domain(reserved)


@pytest.fixture
def start_node(domain, tmp_path):
    """Function that starts the node with ROS arguments such as ``"-p method:=dnl"``."""
    running = []

    def start(*ros_arguments, **options):
        log = tmp_path / f"node{len(running)}.log"
        running.append(NodeProcess(domain, log, ros_arguments, **options))
        return running[-1]

    yield start
    still_running = [node for node in running if node.process.poll() is None]
    try:
        for node in still_running:
            code, _ = node.stop()
            assert (code, "Traceback" in node.log) == (0, False), node.log
    finally:
        for node in running:
            node.kill()


@pytest.fixture
def peer(domain):
    made = Peer(domain)
    yield made
    made.close()
