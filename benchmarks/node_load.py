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
import signal
import struct
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

PROJECT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(PROJECT))

from hand_eye_calib.config import CalibratorConfig  # noqa: E402
from hand_eye_calib.engine.calibrator import Calibrator  # noqa: E402
from hand_eye_calib.errors import InputError  # noqa: E402
from hand_eye_calib.geometry import se3  # noqa: E402
from hand_eye_calib.io.journal import read_journal  # noqa: E402
from hand_eye_calib.io.results import load_result, save_result  # noqa: E402

PARTS = ("load", "share", "busy", "soak", "kill")
STREAMS = ("parent", "child")
T_PARENT_CHILD = se3.exp(np.array([0.4, -0.3, 0.2, 1.1, -0.7, 0.5]))
START_NS = 1_700_000_000_000_000_000
# Of each pose (m, rad). B5 at 400 Hz spans 12 ms: with a centimetre of noise there would be nothing
# to solve.
NOISE = 2e-5, 5e-6

MOST_LATENCY_S = 0.010
MOST_LATENCY_OF_A_SHARE_S = 0.030
MOST_UNREPORTED = 0.02
MOST_CPU = 1.0
MOST_GROWTH = 0.10
MOST_LOST_S = 1.0
# A solve after hours may take so much longer than after one: other programs run on the machine.
MOST_SLOWDOWN = 1.5


def drive(first, n_poses, rate_hz, seed=0):
    """Positions (N, 3) and quaternions (N, 4) of both sensors from pose number ``first`` on, with
    noise.
    """
    s = (first + np.arange(n_poses)) / rate_hz
    turns = np.stack(
        [0.3 * np.sin(0.7 * s), 0.2 * np.sin(0.9 * s + 1.0), 1.2 * np.sin(0.1 * s)], axis=1
    )
    places = np.stack([20 * np.sin(0.05 * s), 20 * np.sin(0.07 * s), 0.5 * np.cos(0.8 * s)], axis=1)
    Ts_pw_p = se3.from_rotation_translation(se3.rotation_exp(turns), places)
    noise = np.random.default_rng([seed, first]).normal(size=(2, n_poses, 6)) * np.repeat(NOISE, 3)
    poses = Ts_pw_p @ se3.exp(noise[0]), Ts_pw_p @ T_PARENT_CHILD @ se3.exp(noise[1])
    return {
        stream: (Ts[:, :3, 3], se3.to_quat_xyzw(Ts))
        for stream, Ts in zip(STREAMS, poses, strict=True)
    }


# ---------------------------------------------------------------------- load


# Set for a node whose solves take two seconds of pure Python.
SLOW = "HAND_EYE_CALIB_SLOW"
SLOW_SOLVER = """
import time
from hand_eye_calib.live import solving
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
    from hand_eye_calib.live import cycle
    from hand_eye_calib.live.solving import SolvingProcess
    from hand_eye_calib.ros.calibrator_node import CalibratorNode
    from hand_eye_calib.ros.inputs import TopicInput
    from hand_eye_calib.ros.node import main

    if SLOW in os.environ:
        cycle.SolvingProcess = functools.partial(SolvingProcess, command=SLOW_SOLVER)

    latencies, durations, used = [], [], []
    receive, sent_at = TopicInput.receive, place_of_sending_time()

    def stopwatch(self, read, data, info):
        begun = time.time()
        if not latencies:
            used.append((time.monotonic(), cpu_seconds()))
        latencies.append(begun - struct.unpack_from("<d", data, sent_at)[0])
        receive(self, read, data, info)
        durations.append(time.time() - begun)
        if len(latencies) % 100 == 0:
            used[1:] = [(time.monotonic(), cpu_seconds())]

    TopicInput.receive = stopwatch
    stop = CalibratorNode.stop

    def stop_and_report(self, timeout_s):
        (start_s, start_cpu_s), (end_s, end_cpu_s) = used[0], used[-1]
        result = self._cycle.result
        document = {
            "received": len(latencies),
            "lost_as_reported": sum(each._lost for each in self._inputs),
            "cpu": (end_cpu_s - start_cpu_s) / (end_s - start_s),
            "latency": np.percentile(latencies, [50, 99, 99.9, 100]).tolist(),
            "duration": np.percentile(durations, [50, 99, 99.9, 100]).tolist(),
            "solves": self._cycle.solves,
            "pairs": result.n_pairs if result else 0,
            "inliers": result.n_inliers if result else 0,
            "error_m": float(np.linalg.norm(result.T_parent_child[:3, 3] - T_PARENT_CHILD[:3, 3]))
            if result
            else None,
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
            stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
            ticks += int(stat[11]) + int(stat[12])
    return ticks / os.sysconf("SC_CLK_TCK")


class Publisher:
    """Two Odometry topics at a steady rate, from a process or thread of their own."""

    def __init__(self, domain, rate_hz):
        import rclpy
        from nav_msgs.msg import Odometry
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        self.rate_hz = rate_hz
        self._context = rclpy.Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = rclpy.create_node("load", context=self._context)
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        self._publishers = {
            stream: self._node.create_publisher(Odometry, f"{stream}_odom", qos)
            for stream in STREAMS
        }
        self._messages = {stream: Odometry() for stream in STREAMS}
        for stream, message in self._messages.items():
            message.header.frame_id, message.child_frame_id = "world", f"{stream}_sensor"
        self.last_stamp_ns = 0

    @property
    def is_matched(self):
        return all(publisher.get_subscription_count() for publisher in self._publishers.values())

    def wait_matched(self):
        end = time.monotonic() + 30.0
        while not self.is_matched:
            if time.monotonic() > end:
                raise RuntimeError("the node does not subscribe")
            time.sleep(0.01)

    def run(self, n_poses, first=0, stop=None):
        """Publish poses ``first`` ... ``first + n_poses`` of both streams on time."""
        poses = {
            stream: [values.tolist() for values in part]
            for stream, part in drive(first, n_poses, self.rate_hz).items()
        }
        begun = time.monotonic()
        for k in range(n_poses):
            if stop is not None and stop.is_set():
                return
            wait_s = begun + k / self.rate_hz - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            stamp_ns = START_NS + (first + k) * round(1e9 / self.rate_hz)
            for stream in STREAMS:
                self._publish(stream, stamp_ns, poses[stream][0][k], poses[stream][1][k])
            self.last_stamp_ns = stamp_ns

    def _publish(self, stream, stamp_ns, position, quat_xyzw):
        message = self._messages[stream]
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y, place.z = position
        turn.x, turn.y, turn.z, turn.w = quat_xyzw
        message.pose.covariance[0] = time.time()
        self._publishers[stream].publish(message)

    def close(self):
        self._node.destroy_node()
        self._context.try_shutdown()


def publish(domain, rate_hz, n_poses):
    """Publish everything once the node listens; the process of its own."""
    publisher = Publisher(domain, rate_hz)
    publisher.wait_matched()
    time.sleep(0.5)
    publisher.run(n_poses)
    time.sleep(4.0)  # a node that is behind has this to catch up
    publisher.close()
    return 0


def start(domain, *words, stdout=None, **more):
    """Another process of this file, or of the package."""
    environment = os.environ | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "OMP_NUM_THREADS": "1",
        "PYTHONUNBUFFERED": "1",
    }
    return subprocess.Popen(
        [sys.executable, *map(str, words)],
        env=environment | more,
        cwd=PROJECT,
        stdout=stdout,
        stderr=subprocess.STDOUT,
    )


def children(pid):
    """Processes that a process has started."""
    found = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # a thread that has just ended
            found += map(int, (task / "children").read_text(encoding="ascii").split())
    return found


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

    def undo():
        for group in groups:
            for pid in (group / "cgroup.procs").read_text(encoding="ascii").split():
                (group.parent / "cgroup.procs").write_text(pid)
            group.rmdir()

    return undo


def others(count):
    """Programs that load all cores, at the usual priority; ends them."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    return lambda: [(each.kill(), each.wait()) for each in busy]


def loaded_node(folder, name, seconds, disturb=None, **environment):
    """What the node saw of two streams at 400 Hz; ``disturb(node)`` makes life hard for it, and
    returns what undoes that.
    """
    rate_hz, domain = 400, random.randint(1, 100)
    report = folder / f"{name}.json"
    options = {
        "method": "dnlo",
        "reference": "B5",
        "solve_period": 1.0,
        "max_pairs": 5005,
        "output_directory": folder / name,
        "report": "false",  # it would load the machine in the next part
    }
    parameters = [
        word for option, value in options.items() for word in ("-p", f"{option}:={value}")
    ]
    words = ("--node", report, "--ros-args", "--log-level", "warn", *parameters)
    node = start(domain, __file__, *words, **environment)
    undo = disturb(node) if disturb else lambda: None
    n_poses = round(seconds * rate_hz)
    try:
        if start(domain, __file__, "--publish", rate_hz, n_poses).wait():
            raise RuntimeError("the publisher failed")
        undo()
        node.send_signal(signal.SIGINT)
        begun = time.monotonic()
        code = node.wait(60)
        ended_s = time.monotonic() - begun
    finally:
        node.kill()
    seen = json.loads(report.read_text(encoding="utf-8"))
    return seen | {"published": 2 * n_poses, "ended_s": ended_s, "code": code}


def load(seen, most_latency_s=MOST_LATENCY_S, may_lose=False):
    """Rows (what, value, promise, kept) of the node under load."""
    latency, duration = seen["latency"], seen["duration"]
    lost, reported = seen["published"] - seen["received"], seen["lost_as_reported"]
    unreported = abs(lost - reported)
    kept = unreported <= MOST_UNREPORTED * lost
    promise, code = "" if may_lose else "0", seen["code"]
    return [
        ("messages lost", f"{lost} of {seen['published']}", promise, may_lose or lost == 0),
        ("messages lost, as reported", str(reported), "within 2 %", kept),
        (
            "latency p50 / p99 / p99.9 / max (ms)",
            _ms(latency),
            "" if may_lose else f"p99 < {1000 * most_latency_s:.0f}",
            may_lose or latency[1] < most_latency_s,
        ),
        ("callback p50 / p99 / p99.9 / max (ms)", _ms(duration), "", True),
        ("CPU (cores)", f"{seen['cpu']:.2f}", "", True),
        (
            "solves",
            str(seen["solves"]),
            "> 0" if promise else "",
            may_lose or seen["solves"] > 0,
        ),
        ("pairs, inliers of the last", f"{seen['pairs']}, {seen['inliers']}", "", True),
        ("error of the last (mm)", f"{1000 * (seen['error_m'] or 0):.2f}", "", True),
        ("end after Ctrl-C (s), code", f"{seen['ended_s']:.2f}, {code}", "code 0", code == 0),
    ]


def _ms(values):
    return " / ".join(f"{1000 * value:.2f}" for value in values)


# ---------------------------------------------------------------------- soak


def soak(hours):
    """Rows of the engine fed for hours."""
    rate_hz, minute = 100, 6000
    calibrator = Calibrator(CalibratorConfig(reference="B5"))
    history, worst = [], 0.0
    times = np.empty(2 * 60 * minute)
    for hour in range(hours):
        count = 0
        for first in range(hour * 60 * minute, (hour + 1) * 60 * minute, minute):
            poses = {
                stream: [values.tolist() for values in part]
                for stream, part in drive(first, minute, rate_hz).items()
            }
            for k in range(minute):
                stamp_ns = START_NS + (first + k) * 10_000_000
                for stream in STREAMS:
                    begun = time.perf_counter()
                    calibrator.add_pose(stream, stamp_ns, poses[stream][0][k], poses[stream][1][k])
                    times[count] = time.perf_counter() - begun
                    count += 1
        solve_s = float(np.median([_timed(calibrator.estimate)[0] for _ in range(5)]))
        result = calibrator.estimate()
        p99 = float(np.percentile(times, 99))
        worst = max(worst, p99)
        del poses
        history.append((resident_mb(), solve_s, p99, result))
        error = np.linalg.norm(result.T_parent_child[:3, 3] - T_PARENT_CHILD[:3, 3])
        print(
            f"hour {hour + 1}: {history[-1][0]:.1f} MB, solve {solve_s * 1e3:.0f} ms, per "
            f"pose p99 {p99 * 1e6:.1f} us, {result.n_poses} poses, error "
            f"{error * 1e3:.2f} mm",
            flush=True,
        )
    (first_mb, first_solve, _, _), (last_mb, last_solve, _, result) = history[0], history[-1]
    growth, slowdown = last_mb / first_mb - 1, last_solve / first_solve
    return [
        (
            f"memory after 1 h, {hours} h (MB)",
            f"{first_mb:.1f}, {last_mb:.1f}",
            "within 10 %",
            growth < MOST_GROWTH,
        ),
        (
            "solve after the first, last hour (ms)",
            f"{first_solve * 1e3:.0f}, {last_solve * 1e3:.0f}",
            "flat",
            slowdown < MOST_SLOWDOWN,
        ),
        ("per pose p99, worst hour (us)", f"{worst * 1e6:.1f}", "< 50", worst < 50e-6),
        ("poses kept", str(result.n_poses), "<= 5000", result.n_poses <= 5000),
    ]


def _timed(work):
    begun = time.perf_counter()
    result = work()
    return time.perf_counter() - begun, result


def resident_mb():
    """Memory of this process, without what the allocator only keeps for later."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no VmRSS in /proc/self/status")


# ---------------------------------------------------------------------- kill


def kill(folder, kills):
    """Rows of the node killed and resumed."""
    rate_hz, domain, output = 100, random.randint(1, 100), folder / "kill"
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    publisher = Publisher(domain, rate_hz)
    save_result(earlier_result(), output)
    before = fingerprints(output)
    lost_s, resumed, unchanged, whole, first, count = [], 0, 0, 0, 0, 0
    for attempt in range(kills):
        node, log = start_logged(domain, output, folder / f"kill{attempt}.log", "resume")
        publisher.wait_matched()
        if attempt:
            resumed += f"{count} poses" in wait_for(log, "session resumed from")
        stop = threading.Event()
        feeding = threading.Thread(target=publisher.run, args=(1_000, first, stop))
        feeding.start()
        first_ns = START_NS + first * round(1e9 / rate_hz)
        while not has_poses_since(output / "journal", first_ns):
            time.sleep(0.05)
        time.sleep(random.uniform(0.0, 3.0))
        newest_ns = publisher.last_stamp_ns
        node.kill()
        node.wait()
        stop.set()
        feeding.join()
        first = (publisher.last_stamp_ns - START_NS) // round(1e9 / rate_hz) + 1
        journal = read_journal(output / "journal")
        whole += 1
        count = len(journal.stamps_ns)
        lost_s.append((newest_ns - min(newest(journal, stream) for stream in STREAMS)) * 1e-9)
        unchanged += (
            before.items() <= fingerprints(output).items()
        )  # the node adds files of its own
        load_result(output)
    node, log = start_logged(domain, output, folder / "last.log", "resume")
    resumed += f"{count} poses" in wait_for(log, "session resumed from")
    node.send_signal(signal.SIGTERM)
    code = node.wait(30)
    publisher.close()
    return [
        ("journals read", f"{whole} of {kills}", "all, with poses", whole == kills and count > 0),
        ("sessions resumed with all of it", f"{resumed} of {kills}", "all", resumed == kills),
        (
            "poses lost (s): mean, worst",
            f"{np.mean(lost_s):.3f}, {max(lost_s):.3f}",
            "< 1",
            max(lost_s) < MOST_LOST_S,
        ),
        ("earlier result files unchanged", f"{unchanged} of {kills}", "all", unchanged == kills),
        ("poses in the session at the end", str(count), "", True),
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
    for stream, (positions, quats) in drive(0, 300, 10).items():
        for k, (position, quat) in enumerate(zip(positions.tolist(), quats.tolist(), strict=True)):
            calibrator.add_pose(stream, k * 100_000_000, position, quat)
    return calibrator.estimate()


def fingerprints(folder):
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.iterdir()
        if path.is_file()
    }


def start_logged(domain, output, log, journal):
    with log.open("wb") as file:
        return subprocess.Popen(
            [
                *(sys.executable, "-m", "hand_eye_calib", "calibrator", "--ros-args"),
                *("-p", f"output_directory:={output}", "-p", f"journal:={journal}"),
                *("-p", "solve_period:=0.5"),
            ],
            env=os.environ | {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"},
            cwd=PROJECT,
            stdout=file,
            stderr=file,
        ), log


def wait_for(log, text):
    end = time.monotonic() + 30
    while text not in (said := log.read_text(encoding="utf-8", errors="replace")):
        if time.monotonic() > end:
            raise RuntimeError(f"the node does not say {text!r}:\n{said}")
        time.sleep(0.02)
    return said


# ---------------------------------------------------------------------- main


def show(title, rows):
    """Print a table; whether all promises were kept."""
    table = Table(title=title)
    for heading in ("what", "measured", "promised", ""):
        table.add_column(heading)
    for what, value, promise, kept in rows:
        table.add_row(what, value, promise, "" if kept else "BROKEN")
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    return all(kept for *_, kept in rows)


def main(arguments):
    """Run the parts that were asked for; exit code."""
    if arguments[:1] == ["--node"]:
        return measured_node(Path(arguments[1]), arguments[2:])
    if arguments[:1] == ["--publish"]:
        return publish(int(os.environ["ROS_DOMAIN_ID"]), int(arguments[1]), int(arguments[2]))
    parser = argparse.ArgumentParser(description="Load, soak and crashes of the node, measured.")
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="all by default")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a load")
    parser.add_argument("--hours", type=int, default=10, help="length of soak, simulated")
    parser.add_argument("--kills", type=int, default=20, help="how often to kill the node")
    parser.add_argument("--share", type=float, default=0.4, help="of a core, for share")
    options = parser.parse_args(arguments)
    good = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = {
            "load": lambda: load(loaded_node(folder, "load", options.seconds)),
            "share": lambda: load(
                loaded_node(
                    folder,
                    "share",
                    options.seconds,
                    disturb=lambda node: slow_processor(node, options.share),
                    **{SLOW: "1"},
                ),
                MOST_LATENCY_OF_A_SHARE_S,
            ),
            "busy": lambda: load(
                loaded_node(
                    folder,
                    "busy",
                    options.seconds,
                    disturb=lambda _: others(4 * (os.cpu_count() or 1)),
                    **{SLOW: "1"},
                ),
                may_lose=True,
            ),
            "soak": lambda: soak(options.hours),
            "kill": lambda: kill(folder, options.kills),
        }
        for part in options.parts or PARTS:
            good &= show(part, run[part]())
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
