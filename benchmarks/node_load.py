"""Load, soak and crashes of the node, measured.

    OMP_NUM_THREADS=1 python benchmarks/node_load.py [load] [share] [busy] [soak] [kill]
    [--seconds 60] [--hours 10] [--kills 20]

load   two Odometry streams at 400 Hz for a minute, DNLO on 5,000 pairs every second: messages
       lost, latency of the callbacks, CPU
share  the same with a share of a core for the node and for its solving process (cgroups v1), every
       solve taking two seconds of pure Python
busy   the same while other programs load all cores: messages lost against messages reported lost
soak   10 hours of 2 x 100 Hz, simulated, through the engine: memory and solve time hour by hour
kill   kill -9 of the node at random moments, and resuming: what is lost

Prints a table per part and fails (exit code 1) where a promise is broken. Latency is from just
before ``publish()`` in one process to the beginning of the callback in the other.
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

MOST_LATENCY_S = 0.010
MOST_LATENCY_OF_A_SHARE_S = 0.030
MOST_UNREPORTED = 0.02
MOST_GROWTH = 0.10
MOST_LOST_S = 1.0
# A solve after hours may take so much longer than after one: other programs run on the machine.
MOST_SLOWDOWN = 1.5


# ---------------------------------------------------------------------- load


# Set for a node whose solves take two seconds of pure Python.
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
    """The node as it is, with a stopwatch at its pose callback; writes what it saw when it is told
    to end.
    """
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
            "lost_as_reported": sum(each._lost for each in self._inputs),
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
    """Where in the bytes of a message of either stream the publisher's clock is."""
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
    """Of this process and of the one that solves for it."""
    ticks = 0
    for pid in (os.getpid(), *children(os.getpid())):
        with contextlib.suppress(FileNotFoundError):  # it has just been killed
            stat = (
                Path(f"/proc/{pid}/stat")
                .read_text(encoding="ascii")
                .rpartition(")")[2]
                .split()
            )
            ticks += int(stat[11]) + int(stat[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def publish(publishers, first, n_poses, rate_hz):
    """Publish poses number ``first`` to ``first + n_poses`` of both streams on time."""
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
    """Publish everything once the node listens; the process of its own."""
    from ros_harness import Peer

    # A sensor is on time whatever else this machine does: messages that were held up would come all
    # at once, and the last of them wait.
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    peer = Peer(int(os.environ["ROS_DOMAIN_ID"]))
    publishers = peer.publishers()
    peer.wait_matched(*publishers)
    time.sleep(0.5)
    publish(publishers, 0, n_poses, rate_hz)
    time.sleep(4.0)  # a node that is behind has this to catch up
    peer.close()
    return 0


def start(domain, *words, **more):
    """Another process of this file."""
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
    """Processes that a process has started."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # a thread that has just ended
            found += map(
                int, (task / "children").read_text(encoding="ascii").split()
            )
    return found


# Time used is charged at the kernel's tick, often 4 ms apart, and when another program wakes up on
# that core: without these, a program that has used up its share of 5 ms ran 4 and stood still 16.
WAKES_UP = """
import os, sys, time
os.sched_setaffinity(0, [int(sys.argv[1])])
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
while True:
    time.sleep(0.001)
"""


def slow_processor(node, share):
    """Give the node, and its solving process, a share of a core each; undoes that."""
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
        # Short periods: a slow processor does not stop for long either.
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
    """Programs that load all cores, at the usual priority; ends them."""
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(count)
    ]
    return lambda: end(busy)


def end(programs):
    """End programs that never end by themselves."""
    for each in programs:
        each.kill()
        each.wait()


def loaded_node(folder, name, seconds, disturb=None, **environment):
    """What the node saw of two streams at 400 Hz; ``disturb(node)`` makes life hard for it, and
    returns what undoes that.
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
        "report": "false",  # it would load the machine in the next part
    }
    given = [
        word
        for option, value in options.items()
        for word in ("-p", f"{option}:={value}")
    ]
    words = ("--node", report, "--ros-args", "--log-level", "warn", *given)
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
    seen = json.loads(report.read_text(encoding="utf-8"))
    return seen | {"published": 2 * n_poses, "ended_s": ended_s, "code": code}


def load(seen, most_latency_s=MOST_LATENCY_S, may_lose=False):
    """Rows (what, value, promise, kept) of the node under load."""
    latency = seen["latency"]
    code = seen["code"]
    lost = seen["published"] - seen["received"]
    reported = seen["lost_as_reported"]
    is_reported = abs(lost - reported) <= MOST_UNREPORTED * lost
    quick = latency[1] < most_latency_s
    promised = f"p99 < {1000 * most_latency_s:.0f}"
    callbacks = _ms(seen["duration"])
    last = f"{seen['pairs']}, {seen['error']:.2f}"
    rows = [
        ("messages lost", f"{lost} of {seen['published']}", "0", lost == 0),
        ("latency p50 / p99 / p99.9 / max (ms)", _ms(latency), promised, quick),
        ("solves", str(seen["solves"]), "> 0", seen["solves"] > 0),
    ]
    if may_lose:
        rows = [(what, value, "", True) for what, value, _, _ in rows]
    return [
        *rows,
        (
            "messages lost, as reported",
            str(reported),
            "within 2 %",
            is_reported,
        ),
        ("callback p50 / p99 / p99.9 / max (ms)", callbacks, "", True),
        ("CPU (cores)", f"{seen['cpu']:.2f}", "", True),
        ("pairs, error (mm) of the last", last, "", True),
        (
            "end after Ctrl-C (s), code",
            f"{seen['ended_s']:.2f}, {code}",
            "code 0",
            code == 0,
        ),
    ]


def _ms(values):
    return " / ".join(f"{1000 * value:.2f}" for value in values)


# ---------------------------------------------------------------------- soak


def soak(hours):
    """Rows of the engine fed for hours."""
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
        said = "{:.1f} MB, solve {:.0f} ms, per pose p99 {:.1f} us".format(
            *history[-1]
        )
        print(f"hour {hour + 1}: {said}, {result.n_poses} poses", flush=True)
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
    """Memory of this process, without what the allocator only keeps for later."""
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
    """Rows of the node killed and resumed."""
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
        # The node adds its own topics.
        unchanged += before.items() <= fingerprints(output).items()
        load_result(output)
    code, _ = node.stop(15)
    peer.close()
    lost = f"{np.mean(lost_s):.3f}, {max(lost_s):.3f}"
    return [
        (
            "sessions resumed with all of it",
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
    """Newest stamp of a stream in a journal; 0 without any."""
    return int(journal.stamps_ns[journal.streams == stream].max(initial=0))


def has_poses_since(directory, stamp_ns):
    """Whether the node has noted poses of both streams from this stamp on."""
    try:
        journal = read_journal(directory)
    except InputError:  # not there yet
        return False
    return all(newest(journal, stream) >= stamp_ns for stream in STREAMS)


def earlier_result():
    """A calibration of another day."""
    calibrator = Calibrator(CalibratorConfig(reference="B5"))
    for stream, columns in parts(0, 300, 10).items():
        for pose in zip(*columns, strict=True):
            calibrator.add_pose(stream, *pose)
    return calibrator.estimate()


def fingerprints(folder):
    files = [path for path in folder.iterdir() if path.is_file()]
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


# ---------------------------------------------------------------------- main


def main(arguments):
    """Run the parts that were asked for; exit code."""
    if arguments[:1] == ["--node"]:
        return measured_node(Path(arguments[1]), arguments[2:])
    if arguments[:1] == ["--publish"]:
        return publish_alone(int(arguments[1]), int(arguments[2]))
    parser = argparse.ArgumentParser(
        description="Load, soak and crashes of the node, measured."
    )
    parser.add_argument(
        "parts", nargs="*", choices=[*PARTS, []], help="all by default"
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="length of a load"
    )
    parser.add_argument(
        "--hours", type=int, default=10, help="length of soak, simulated"
    )
    parser.add_argument(
        "--kills", type=int, default=20, help="how often to kill the node"
    )
    parser.add_argument(
        "--share", type=float, default=0.4, help="of a core, for share"
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
            hard = functools.partial(slow_processor, share=options.share)
            seen = loaded_node(
                folder, part, options.seconds, hard, **{SLOW: "1"}
            )
            return load(seen, MOST_LATENCY_OF_A_SHARE_S)
        n_programs = 4 * (os.cpu_count() or 1)
        hard = lambda _: others(n_programs)  # noqa: E731
        return load(
            loaded_node(folder, part, options.seconds, hard, **{SLOW: "1"}),
            may_lose=True,
        )

    good = True
    with tempfile.TemporaryDirectory() as name:
        for part in options.parts or PARTS:
            rows = run(part, Path(name))
            good &= all(kept for *_, kept in rows)
            lines = [[*line, "" if kept else "BROKEN"] for *line, kept in rows]
            show([Table(part, ["measured", "promised", ""], lines)])
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
