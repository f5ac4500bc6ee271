"""Measure the node under load, over hours, and after crashes.

    OMP_NUM_THREADS=1 python benchmarks/node_load.py [load] [share] [busy] [soak] [kill]
    [--seconds 60] [--hours 10] [--kills 20]

load   two Odometry streams at 400 Hz for a minute, DNLO on 5,000 pairs every second: lost
       messages, latency of the callbacks, CPU
share  as load, but the node and its solving process get a share of a core each (cgroups v1), and
       every solve takes two seconds of pure Python
busy   as load, with slow solves, while other programs load all cores: lost messages, and lost
       messages that the node reports
soak   10 simulated hours of 2 x 100 Hz in the engine: memory and solve time of every hour
kill   kill -9 of the node at random moments, and restarts: lost poses

Prints a table for each part. The exit code is 1 if a promise is broken. Latency is the time from
just before ``publish()`` in one process to the beginning of the callback in the other process.
"""

import argparse
import contextlib
import ctypes
import functools
import gc
import hashlib
import json
import math
import os
import random
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [
    str(PROJECT),
    str(PROJECT / "benchmarks"),
    str(PROJECT / "test"),
]

from suite.data import START_NS, STREAMS, T_PARENT_CHILD, parts  # noqa: E402
from suite.table import Table, show  # noqa: E402

from hand_eye_calib.core.base.config import CalibratorConfig  # noqa: E402
from hand_eye_calib.core.base.errors import InputError  # noqa: E402
from hand_eye_calib.core.engine.calibrator import Calibrator  # noqa: E402
from hand_eye_calib.formats.journal import read_journal  # noqa: E402
from hand_eye_calib.formats.results import load_result, save_result  # noqa: E402

PARTS = ("load", "share", "busy", "soak", "kill")

# Largest 99th percentile of the latency (s).
MOST_LATENCY_S = 0.010
# The same for a node with a share of a core (s).
MOST_LATENCY_OF_A_SHARE_S = 0.030
# Largest difference of the reported number of lost messages, as a share of the lost messages.
MOST_UNREPORTED = 0.02
# Largest growth of the memory during the soak.
MOST_GROWTH = 0.10
# Longest time (s) of poses that a crash may lose.
MOST_LOST_S = 1.0
# Largest ratio of the solve times after the last and the first hour. Other programs may run on the
# machine.
MOST_SLOWDOWN = 1.5


# ---------------------------------------------------------------------- load


# Environment variable for a node whose solves take two seconds of pure Python.
SLOW = "HAND_EYE_CALIB_SLOW"
SLOW_SOLVER = """
import time
from hand_eye_calib.online.live import solving
excitation = solving.excitation
def slow(pose_pairs):
    end = time.process_time() + 2.0
    count = 0
    while time.process_time() < end:
        count += 1
    return excitation(pose_pairs)
solving.excitation = slow
solving.main()
"""


def measured_node(report, arguments):
    """Run the node, and measure its pose callback; write a report when the node stops."""
    from hand_eye_calib.online.live import cycle
    from hand_eye_calib.online.live.solving import SolvingProcess
    from hand_eye_calib.online.ros.calibrator_node import CalibratorNode
    from hand_eye_calib.online.ros.inputs import TopicInput
    from hand_eye_calib.online.ros.node import main

    if SLOW in os.environ:
        cycle.SolvingProcess = functools.partial(
            SolvingProcess, command=SLOW_SOLVER
        )

    latencies = []
    durations = []
    used = []
    receive = TopicInput._receive
    sent_at = place_of_sending_time()

    def stopwatch(self, data, info):
        begun = time.time()
        if not latencies:
            used.append((time.monotonic(), cpu_seconds()))
        latencies.append(begun - struct.unpack_from("<d", data, sent_at)[0])
        receive(self, data, info)
        durations.append(time.time() - begun)
        if len(latencies) % 100 == 0:
            used[1:] = [(time.monotonic(), cpu_seconds())]

    TopicInput._receive = stopwatch
    stop = CalibratorNode.stop
    conclude = cycle.SolveCycle.conclude
    solves = []
    cycle.SolveCycle.conclude = lambda *answered: (
        solves.append(0) or conclude(*answered)
    )

    def stop_and_report(self, timeout_s):
        start_s, start_cpu_s = used[0]
        end_s, end_cpu_s = used[-1]
        result = self._cycle.result
        document = {
            "received": len(latencies),
            "lost_as_reported": sum(topic._lost for topic in self._inputs),
            "cpu": (end_cpu_s - start_cpu_s) / (end_s - start_s),
            "latency": np.percentile(latencies, [50, 99, 99.9, 100]).tolist(),
            "duration": np.percentile(durations, [50, 99, 99.9, 100]).tolist(),
            "solves": len(solves),
            "pairs": result.n_pairs if result else 0,
            "error": 1e3 * math.dist(result.translation, T_PARENT_CHILD[:3, 3])
            if result
            else 0,
        }
        report.write_text(json.dumps(document), encoding="utf-8")
        return stop(self, timeout_s)

    CalibratorNode.stop = stop_and_report
    return main(arguments)


def place_of_sending_time():
    """Return the position of the sending time in the bytes of a message, equal for both streams.

    The publisher writes its clock into the first number of the pose's covariance.
    """
    from nav_msgs.msg import Odometry
    from rclpy.serialization import serialize_message

    places = set()
    for stream in STREAMS:
        message = Odometry(child_frame_id=f"{stream}_sensor")
        message.header.frame_id = "world"
        message.pose.covariance[0] = math.pi
        places.add(serialize_message(message).index(struct.pack("<d", math.pi)))
    (place,) = places
    return place


def cpu_seconds():
    """Return the processor time (s) of this process and of its children."""
    ticks = 0
    for pid in (os.getpid(), *children(os.getpid())):
        # A child may have ended just now.
        with contextlib.suppress(FileNotFoundError):
            text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii")
            fields = text.rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def publish(publishers, first, n_poses, rate_hz):
    """Publish the poses ``first`` to ``first + n_poses`` of both streams in real time."""
    from nav_msgs.msg import Odometry

    message = Odometry()
    message.header.frame_id = "world"
    place = message.pose.pose.position
    turn = message.pose.pose.orientation
    streams = parts(first, n_poses, rate_hz)
    begun = time.monotonic()
    for k in range(n_poses):
        time.sleep(max(0.0, begun + k / rate_hz - time.monotonic()))
        for publisher, (stream, (stamps_ns, positions, quats)) in zip(
            publishers, streams.items(), strict=True
        ):
            message.child_frame_id = f"{stream}_sensor"
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(stamps_ns[k], 1_000_000_000)
            place.x, place.y, place.z = positions[k]
            turn.x, turn.y, turn.z, turn.w = quats[k]
            message.pose.covariance[0] = time.time()
            publisher.publish(message)


def publish_alone(rate_hz, n_poses):
    """Publish all poses when the node has subscribed; main function of the publisher's process."""
    from ros_harness import Peer

    # The publisher gets real-time priority, because a sensor is never late. Late messages would
    # arrive in bursts, and wait for each other.
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    peer = Peer(int(os.environ["ROS_DOMAIN_ID"]))
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    time.sleep(0.5)
    publish(publishers, 0, n_poses, rate_hz)
    # Time for the node to process its queue.
    time.sleep(4.0)
    peer.close()
    return 0


def start(domain, *words, **more):
    """Start this file in another process."""
    environment = {
        "ROS_DOMAIN_ID": str(domain),
        "OMP_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
    }
    command = [sys.executable, __file__, *map(str, words)]
    return subprocess.Popen(
        command, env=os.environ | environment | more, cwd=PROJECT
    )


def children(pid):
    """Return the numbers of the processes that a process has started."""
    pids = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        # A thread may have ended just now.
        with contextlib.suppress(OSError):
            text = (task / "children").read_text(encoding="ascii")
            pids += [int(word) for word in text.split()]
    return pids


# Program that wakes up every millisecond on a core. The kernel accounts processor time at its tick,
# often every 4 ms, and whenever another program wakes up. Without such a program, a process with a
# quota per 5 ms ran for 4 ms and then paused for 16 ms.
WAKES_UP = """
import os, sys, time
os.sched_setaffinity(0, [int(sys.argv[1])])
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
while True:
    time.sleep(0.001)
"""


def slow_processor(node, share):
    """Limit the node and its solving process to a share of a core each.

    Returns a function that removes the limits.
    """
    groups = []
    own = Path("/proc/self/cgroup").read_text(encoding="ascii").splitlines()
    here = next(line.rpartition(":")[2] for line in own if ":cpu:" in line)
    for _ in range(100):
        if children(node.pid):
            break
        time.sleep(0.05)
    for pid in (node.pid, *children(node.pid)):
        group = Path(f"/sys/fs/cgroup/cpu{here}/slow_{pid}")
        group.mkdir()
        # Periods are short, because a slow processor never pauses for long.
        (group / "cpu.cfs_period_us").write_text("5000")
        (group / "cpu.cfs_quota_us").write_text(str(round(5000 * share)))
        (group / "cgroup.procs").write_text(str(pid))
        groups.append(group)
    cores = os.sched_getaffinity(0)
    waking = [
        subprocess.Popen([sys.executable, "-c", WAKES_UP, str(core)])
        for core in cores
    ]

    def undo():
        end(waking)
        for group in groups:
            for pid in (
                (group / "cgroup.procs").read_text(encoding="ascii").split()
            ):
                (group.parent / "cgroup.procs").write_text(pid)
            group.rmdir()

    return undo


def others(count):
    """Start programs that load all cores; return a function that ends them."""
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(count)
    ]
    return lambda: end(busy)


def end(programs):
    """Kill programs."""
    for program in programs:
        program.kill()
        program.wait()


def loaded_node(folder, name, seconds, disturb=None, **environment):
    """Run a node with two streams at 400 Hz, and return its report.

    ``disturb(node)`` slows the node down, and returns a function that ends the disturbance.
    """
    from ros_harness import free_domain

    rate_hz = 400
    domain = free_domain()
    report = folder / f"{name}.json"
    options = {
        "method": "dnlo",
        "reference": "B5",
        "solve_period": 1.0,
        "max_pairs": 5005,
        "output_directory": folder / name,
        # A report would load the machine in the next part.
        "report": "false",
    }
    parameters = []
    for option, value in options.items():
        parameters += ["-p", f"{option}:={value}"]
    words = ("--node", report, "--ros-args", "--log-level", "warn", *parameters)
    node = start(domain, *words, **environment)
    undo = disturb(node) if disturb else lambda: None
    n_poses = round(seconds * rate_hz)
    try:
        if start(domain, "--publish", rate_hz, n_poses).wait():
            raise RuntimeError("the publisher failed")
        undo()
        node.send_signal(2)
        begun = time.monotonic()
        code = node.wait(60)
        ended_s = time.monotonic() - begun
    finally:
        node.kill()
    measured = json.loads(report.read_text(encoding="utf-8"))
    return measured | {
        "published": 2 * n_poses,
        "ended_s": ended_s,
        "code": code,
    }


def load(measured, most_latency_s=MOST_LATENCY_S, may_lose=False):
    """Return rows of the node under load: title, value, promise, whether the promise is kept."""
    latency = measured["latency"]
    code = measured["code"]
    published = measured["published"]
    solves = measured["solves"]
    lost = published - measured["received"]
    reported = measured["lost_as_reported"]
    is_reported = abs(lost - reported) <= MOST_UNREPORTED * lost
    is_quick = latency[1] < most_latency_s
    promise = f"p99 < {1000 * most_latency_s:.0f}"
    callbacks = _ms(measured["duration"])
    last = f"{measured['pairs']}, {measured['error']:.2f}"
    rows = [
        ("messages lost", f"{lost} of {published}", "0", lost == 0),
        (
            "latency p50 / p99 / p99.9 / max (ms)",
            _ms(latency),
            promise,
            is_quick,
        ),
        ("solves", str(solves), "> 0", solves > 0),
    ]
    if may_lose:
        rows = [(title, value, "", True) for title, value, _, _ in rows]
    return [
        *rows,
        (
            "messages lost, as reported",
            str(reported),
            "within 2 %",
            is_reported,
        ),
        ("callback p50 / p99 / p99.9 / max (ms)", callbacks, "", True),
        ("CPU (cores)", f"{measured['cpu']:.2f}", "", True),
        ("pairs, error (mm) of the last result", last, "", True),
        (
            "end after Ctrl-C (s), code",
            f"{measured['ended_s']:.2f}, {code}",
            "code 0",
            code == 0,
        ),
    ]


def _ms(values):
    return " / ".join(f"{1000 * value:.2f}" for value in values)


# ---------------------------------------------------------------------- soak


def soak(hours):
    """Feed the engine with poses for simulated hours; return the rows of memory and times."""
    rate_hz = 100
    minute = 6000
    calibrator = Calibrator(CalibratorConfig(reference="B5"))
    history = []
    for hour in range(hours):
        times = []
        for first in range(
            hour * 60 * minute, (hour + 1) * 60 * minute, minute
        ):
            streams = parts(first, minute, rate_hz).items()
            for k in range(minute):
                for stream, (stamps_ns, positions, quats) in streams:
                    begun = time.perf_counter()
                    calibrator.add_pose(
                        stream, stamps_ns[k], positions[k], quats[k]
                    )
                    times.append(time.perf_counter() - begun)
        p99 = float(np.percentile(times, 99))
        del times, streams
        solves = []
        for _ in range(5):
            begun = time.perf_counter()
            result = calibrator.estimate()
            solves.append(time.perf_counter() - begun)
        history.append(
            (resident_mb(), 1e3 * float(np.median(solves)), 1e6 * p99)
        )
        text = "{:.1f} MB, solve {:.0f} ms, per pose p99 {:.1f} us".format(
            *history[-1]
        )
        print(f"hour {hour + 1}: {text}, {result.n_poses} poses", flush=True)
    first_mb, first_ms, _ = history[0]
    last_mb, last_ms, _ = history[-1]
    memory = f"{first_mb:.1f}, {last_mb:.1f}"
    solve = f"{first_ms:.0f}, {last_ms:.0f}"
    is_flat = last_ms < MOST_SLOWDOWN * first_ms
    worst = max(p99 for *_, p99 in history)
    grown = last_mb / first_mb - 1
    n_poses = result.n_poses
    return [
        (
            f"memory after 1 h, {hours} h (MB)",
            memory,
            "within 10 %",
            grown < MOST_GROWTH,
        ),
        ("solve after the first, last hour (ms)", solve, "flat", is_flat),
        ("per pose p99, worst hour (us)", f"{worst:.1f}", "< 50", worst < 50),
        ("poses kept", str(n_poses), "<= 5000", n_poses <= 5000),
    ]


def resident_mb():
    """Return the memory (MB) of this process, without free memory of the allocator."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(
        int(line.split()[1]) / 1024
        for line in lines
        if line.startswith("VmRSS:")
    )


# ---------------------------------------------------------------------- kill


def kill(folder, kills):
    """Kill and resume the node; return the rows of lost poses and files."""
    from ros_harness import NodeProcess, Peer, free_domain

    rate_hz = 100
    domain = free_domain()
    output = folder / "kill"
    peer = Peer(domain)
    publishers = peer.publishers()
    words = (
        f"-p output_directory:={output}",
        "-p journal:=resume",
        "-p solve_period:=0.5",
    )
    save_result(earlier_result(), output)
    before = fingerprints(output)
    lost_s = []
    resumed = 0
    unchanged = 0
    first = 0
    count = 0
    for attempt in range(kills + 1):
        node = NodeProcess(domain, folder / f"node{attempt}.log", words)
        if attempt:
            resumed += f"{count} poses" in node.wait_for_log(
                "session resumed from"
            )
        if attempt == kills:
            break
        peer.wait_matched(*publishers)
        begun_ns = START_NS + first * 1_000_000_000 // rate_hz
        n_more = random.randint(1, 3 * rate_hz)
        while n_more:
            n_poses = (
                n_more
                if has_poses_since(output / "journal", begun_ns)
                else rate_hz // 4
            )
            n_more = 0 if n_poses == n_more else n_more
            publish(publishers, first, n_poses, rate_hz)
            first += n_poses
        node.kill()
        peer.wait_left(*publishers)
        journal = read_journal(output / "journal")
        count = len(journal.stamps_ns)
        newest_ns = START_NS + (first - 1) * 1_000_000_000 // rate_hz
        lost_s.append(
            (newest_ns - min(newest(journal, stream) for stream in STREAMS))
            * 1e-9
        )
        # The node may add files for its topics.
        unchanged += before.items() <= fingerprints(output).items()
        load_result(output)
    code, _ = node.stop(15)
    peer.close()
    lost = f"{np.mean(lost_s):.3f}, {max(lost_s):.3f}"
    return [
        (
            "sessions resumed with all their poses",
            f"{resumed} of {kills}",
            "all",
            resumed == kills,
        ),
        ("poses lost (s): mean, worst", lost, "< 1", max(lost_s) < MOST_LOST_S),
        (
            "earlier result files unchanged",
            f"{unchanged} of {kills}",
            "all",
            unchanged == kills,
        ),
        ("poses in the session at the end", str(count), "> 0", count > 0),
        ("end after SIGTERM, code", str(code), "0", code == 0),
    ]


def newest(journal, stream):
    """Return the newest stamp of a stream in a journal; 0 without poses."""
    return int(journal.stamps_ns[journal.streams == stream].max(initial=0))


def has_poses_since(directory, stamp_ns):
    """Return whether the journal contains poses of both streams from this stamp on."""
    try:
        journal = read_journal(directory)
    # The journal does not exist yet.
    except InputError:
        return False
    return all(newest(journal, stream) >= stamp_ns for stream in STREAMS)


def earlier_result():
    """Return a result to save before the sessions."""
    calibrator = Calibrator(CalibratorConfig(reference="B5"))
    for stream, columns in parts(0, 300, 10).items():
        for pose in zip(*columns, strict=True):
            calibrator.add_pose(stream, *pose)
    return calibrator.estimate()


def fingerprints(folder):
    """Return the SHA-256 digest of each file in a folder, by name."""
    files = [path for path in folder.iterdir() if path.is_file()]
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


# ---------------------------------------------------------------------- main


def main(arguments):
    """Run the parts in the arguments, and return the exit code."""
    if arguments[:1] == ["--node"]:
        return measured_node(Path(arguments[1]), arguments[2:])
    if arguments[:1] == ["--publish"]:
        return publish_alone(int(arguments[1]), int(arguments[2]))
    parser = argparse.ArgumentParser(
        description="Measure the node under load, over hours, and after crashes."
    )
    parser.add_argument(
        "parts", nargs="*", choices=[*PARTS, []], help="default: all parts"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=60.0,
        help="duration of load, share and busy (s)",
    )
    parser.add_argument(
        "--hours", type=int, default=10, help="simulated duration of soak (h)"
    )
    parser.add_argument(
        "--kills", type=int, default=20, help="number of kills of the node"
    )
    parser.add_argument(
        "--share", type=float, default=0.4, help="share of a core, for share"
    )
    options = parser.parse_args(arguments)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

    def run(part, folder):
        if part == "soak":
            return soak(options.hours)
        if part == "kill":
            return kill(folder, options.kills)
        if part == "load":
            return load(loaded_node(folder, part, options.seconds))
        if part == "share":
            slow_down = functools.partial(slow_processor, share=options.share)
            measured = loaded_node(
                folder, part, options.seconds, slow_down, **{SLOW: "1"}
            )
            return load(measured, MOST_LATENCY_OF_A_SHARE_S)
        n_programs = 4 * (os.cpu_count() or 1)
        measured = loaded_node(
            folder,
            part,
            options.seconds,
            lambda _: others(n_programs),
            **{SLOW: "1"},
        )
        return load(measured, may_lose=True)

    are_kept = True
    with tempfile.TemporaryDirectory() as name:
        for part in options.parts or PARTS:
            lines = []
            for *texts, is_kept in run(part, Path(name)):
                are_kept = are_kept and is_kept
                lines.append([*texts, "" if is_kept else "BROKEN"])
            show([Table(part, ["measured", "promised", ""], lines)])
    return 0 if are_kept else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
