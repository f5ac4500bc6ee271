"""Fourteen live sessions of the real node: do all surfaces agree, second by second?

    python benchmarks/node_sessions.py [SESSION ...] [--out DIRECTORY] [--seed SEED]

Twelve sessions are a minute or two of simulated driving, published in real time. Most have an
accident: a knock, a stream that stops, a wrong ``installed`` ... In two sessions, a vehicle drives
over ramps for ten minutes. The node's advice and times left are compared with the rest of the
session. A witness records the state of the node, its topics, ``/diagnostics``, ``/tf_static``, the
page of ``watch``, the log and the saved files. Their contents are compared at every second, and
every screen with the rules of ``test/screen_rules.py``. Prints a table. The exit code is 1 if
contents contradict each other, or a session does not end as expected. With ``--out``, all pages and
headlines are saved (``watch_picture.py`` makes a moving picture of them).
"""

import argparse
import contextlib
import dataclasses
import functools
import http.client
import itertools
import json
import math
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from html import unescape
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).resolve().parents[1]
sys.path[:0] = [
    str(PROJECT),
    str(PROJECT / "benchmarks"),
    str(PROJECT / "test"),
]

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import TransformStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from node_load import others  # noqa: E402
from ros_harness import (  # noqa: E402
    LATCHED,
    NodeProcess,
    Peer,
    free_domain,
    matrix,
    message,
    values_of,
)
from screen_rules import faults_of  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from suite.table import Table, show  # noqa: E402

from hand_eye_calib.core.geometry import se3  # noqa: E402
from hand_eye_calib.extras.simulation.drive import add_noise, simulate_drive  # noqa: E402
from hand_eye_calib.extras.simulation.options import HILLY_DRIVE, REALISTIC  # noqa: E402
from hand_eye_calib.formats.results import load_result  # noqa: E402
from hand_eye_calib.online.live.log import GOES_ON_S  # noqa: E402
from hand_eye_calib.online.live.progress import AXIS_KEYS  # noqa: E402
from hand_eye_calib.online.live.state import Broadcast, Standing  # noqa: E402
from hand_eye_calib.online.watch.board import Board, state_of  # noqa: E402
from reproduction.coverage.classes import CLASSES, simulate  # noqa: E402
from reproduction.coverage.motions import RAMP_PERIOD_S, agv_on_request  # noqa: E402

# Seed of the drive of the first session; the next session has the next seed.
SEED = 5800

# Time (s) within which the page must display a new state: the page is updated every 0.25 s, and
# the machine may be loaded.
SETTLED_S = 2.0

# Time (s) that the publisher's process takes to start.
START_S = 6.0

# Motion (s, deg) before which the headline must be neither DONE nor an advice to change the motion.
MIN_MOTION_S = 20.0
MIN_ROTATION_DEG = 30.0

# Numbers of a line of the log.
NUMBERS = r"[\d.,+-]+"

# Longest time (s) from the moment when all axes are within their targets for good, to DONE.
MAX_WAIT_S = 90.0
# Smallest share of the reported times left that are within a factor of two of the truth.
MIN_GOOD_TIMES = 0.8

# Headlines that may replace DONE and GO ON at any time.
ALARMS = ("CHECK", "BAD INPUT", "BROKEN", "OLD RESULT", "PAUSED", "CHANGE")


@dataclass
class Streams:
    """Stamps (s from the start) and poses of both sensors."""

    parent_s: np.ndarray
    Ts_parent: np.ndarray
    child_s: np.ndarray
    Ts_child: np.ndarray
    T_parent_child: np.ndarray
    T_pw_cw: np.ndarray


@dataclass(frozen=True)
class Session:
    """Motion and accident of a session, and the headline with which the session must end.

    Attributes
    ----------
    seconds : float
        Duration of the drive (s).
    ends_with : str
        Regular expression for the last headline before the node is stopped.
    rates_hz : (float, float)
        Rates of parent and child, Hz.
    parameters : dict
        Parameters of the node. If ``installed`` is among them, its value is replaced by a transform
        that is wrong by 15 cm and 4 deg.
    accident : callable or None
        Changes the streams.
    load : int
        Number of other programs that load the machine.
    second_publisher_s : float
        Time (s) from which a second program publishes on the child's topic.
    must_appear : str
        Regular expression for a headline or a line of the page that must have been displayed.
    vehicle : str
        Class of the errors of a vehicle that drives over ramps; empty for a drive on hills.
    flat_s : float
        Time (s) before which this vehicle drives on a flat floor.
    """

    seconds: float
    ends_with: str
    rates_hz: tuple[float, float] = (10.0, 20.0)
    parameters: dict = field(default_factory=dict)
    accident: Callable[[Streams], None] | None = None
    load: int = 0
    second_publisher_s: float = math.inf
    must_appear: str = ""
    vehicle: str = ""
    flat_s: float = 0.0


# -------------------------------------------------------------------- accidents


def knock(streams):
    """Turn the child sensor on its mount by 3 deg after 60 s."""
    turned = se3.exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, math.radians(3.0)]))
    later = streams.child_s > 60.0
    streams.Ts_child[later] = streams.Ts_child[later] @ turned


def stop_child(streams):
    """Silence the child from 25 to 45 s."""
    keep = (streams.child_s < 25.0) | (streams.child_s > 45.0)
    streams.child_s = streams.child_s[keep]
    streams.Ts_child = streams.Ts_child[keep]


def end_child(streams):
    """Silence the child from 12 s on."""
    keep = streams.child_s < 12.0
    streams.child_s = streams.child_s[keep]
    streams.Ts_child = streams.Ts_child[keep]


def park(streams):
    """Park from 25 to 55 s; the drive then continues at the same place.

    The poses of both sensors while parked are interpolated at the same instant.
    """
    for name in ("parent", "child"):
        times_s = getattr(streams, f"{name}_s")
        Ts = getattr(streams, f"Ts_{name}")
        moving_s = np.where(
            times_s < 25.0, times_s, np.maximum(25.0, times_s - 30.0)
        )
        # The poses before and after each wanted time.
        after = np.searchsorted(times_s, moving_s).clip(1, len(times_s) - 1)
        before = after - 1
        share = (moving_s - times_s[before]) / (
            times_s[after] - times_s[before]
        )
        setattr(
            streams, f"Ts_{name}", se3.interpolate(Ts[before], Ts[after], share)
        )


def replace_start(streams, until_s, motion):
    """Replace the motion of the body before a time.

    ``motion(seconds, Ts)`` returns the new poses of the body in its frame at ``until_s``. The
    arguments are times (s) relative to ``until_s``, and the old poses.
    """
    T_pw_body = streams.Ts_parent[np.abs(streams.parent_s - until_s).argmin()]
    T_cw_pw = se3.inverse(streams.T_pw_cw)
    for name, T_world_pw, T_body_sensor in (
        ("parent", np.eye(4), np.eye(4)),
        ("child", T_cw_pw, streams.T_parent_child),
    ):
        times_s = getattr(streams, f"{name}_s")
        Ts = getattr(streams, f"Ts_{name}")
        T_world_body = T_world_pw @ T_pw_body
        is_early = times_s < until_s
        Ts_body = (
            se3.inverse(T_world_body)
            @ Ts[is_early]
            @ se3.inverse(T_body_sensor)
        )
        Ts_new = motion(times_s[is_early] - until_s, Ts_body)
        Ts[is_early] = T_world_body @ Ts_new @ T_body_sensor


def straight(seconds, Ts):
    """Drive straight on at 1.5 m/s."""
    Ts = np.tile(np.eye(4), (len(Ts), 1, 1))
    Ts[:, 0, 3] = 1.5 * seconds
    return Ts


def flat(seconds, Ts):
    """Keep x, y and yaw."""
    rpy = np.zeros((len(Ts), 3))
    rpy[:, 2] = np.arctan2(Ts[:, 1, 0], Ts[:, 0, 0])
    return se3.from_rotation_translation(
        se3.rotation_from_rpy(rpy), Ts[:, :3, 3] * [1.0, 1.0, 0.0]
    )


def start_straight(streams):
    """Drive straight on for the first 25 s."""
    replace_start(streams, 25.0, straight)


def start_flat(streams):
    """Drive on a flat floor for the first 65 s, straight on for the first 30 s of them."""
    replace_start(streams, 65.0, flat)
    replace_start(streams, 30.0, straight)


QUIET = {"target.translation": 0.04, "target.rotation": 0.0105}

SESSIONS = {
    "10 and 20 Hz": Session(90.0, "DONE", parameters=QUIET),
    "100 Hz, load 8": Session(90.0, "DONE", (100.0, 100.0), QUIET, load=8),
    "50 and 7 Hz": Session(90.0, "DONE", (50.0, 7.0), QUIET),
    "knock": Session(
        120.0,
        "CHECK THE STREAMS|GO ON|DONE",
        accident=knock,
        must_appear="CHECK THE STREAMS",
    ),
    "wrong installed": Session(
        90.0,
        "DONE",
        parameters=QUIET | {"installed": ""},
        must_appear="HAS MOVED",
    ),
    "contradicted prior": Session(
        60.0,
        "CHECK THE VALUE",
        parameters={"prior.z": "1.5+/-0.01"},
        must_appear="contradicts",
    ),
    "two publishers": Session(
        60.0,
        "BAD INPUT|CHECK",
        second_publisher_s=30.0,
        must_appear="publishers",
    ),
    "straight start": Session(
        90.0, "DONE", parameters=QUIET, accident=start_straight
    ),
    "straight, curves, ramps": Session(
        160.0,
        "DONE",
        parameters=QUIET | {"installed": ""},
        accident=start_flat,
        must_appear="HAS MOVED",
    ),
    "parked": Session(120.0, "DONE", parameters=QUIET, accident=park),
    "child silent for 20 s": Session(
        110.0,
        "DONE",
        parameters=QUIET,
        accident=stop_child,
        must_appear="PAUSED|CHECK INPUT",
    ),
    "child dies, Ctrl-C": Session(
        55.0, "PAUSED|CHECK INPUT", parameters=QUIET, accident=end_child
    ),
    "ramps, 10 min": Session(600.0, "DONE", vehicle="agv_ramps"),
    "flat, then ramps, 10 min": Session(
        600.0, "DONE", vehicle="agv_long", flat_s=90.0
    ),
}


def simulated(session, seed):
    """Return the streams of a session, and the true extrinsic."""
    if session.vehicle:
        return simulated_vehicle(session, seed)
    parent_hz, child_hz = session.rates_hz
    config = dataclasses.replace(
        HILLY_DRIVE,
        poses=round(session.seconds * parent_hz),
        parent_rate=parent_hz,
        child_rate=child_hz,
        start_time=0.0,
    )
    drive = simulate_drive(seed, config)
    streams = Streams(
        drive.parent.stamps_ns * 1e-9,
        drive.parent.poses.copy(),
        drive.child.stamps_ns * 1e-9,
        drive.child.poses.copy(),
        drive.T_parent_child,
        drive.T_pw_cw,
    )
    if session.accident:
        session.accident(streams)
    # The number of jumps per second does not depend on the rate of the messages.
    jumps_per_pose = REALISTIC.outliers * HILLY_DRIVE.parent_rate / parent_hz
    streams.Ts_parent, streams.Ts_child = add_noise(
        streams.Ts_parent,
        streams.Ts_child,
        dataclasses.replace(REALISTIC, outliers=jumps_per_pose),
        np.random.default_rng(seed),
    )
    return streams, drive.T_parent_child


def simulated_vehicle(session, seed):
    """Return the streams of a vehicle that drives over ramps, and the true extrinsic."""
    motion = functools.partial(agv_on_request, flat_s=session.flat_s)
    kind = dataclasses.replace(
        CLASSES[session.vehicle], motion=motion, duration_s=session.seconds
    )
    drive = simulate(kind, (seed,))
    start_ns = min(drive.parent.stamps_ns[0], drive.child.stamps_ns[0])
    times_s = [
        (stream.stamps_ns - start_ns) * 1e-9
        for stream in (drive.parent, drive.child)
    ]
    poses = [stream.poses.copy() for stream in (drive.parent, drive.child)]
    streams = Streams(
        times_s[0],
        poses[0],
        times_s[1],
        poses[1],
        drive.T_parent_child,
        np.eye(4),
    )
    return streams, drive.T_parent_child


# ---------------------------------------------------------------------- witness


@dataclass(frozen=True)
class Page:
    """The page of ``watch``, read back from its HTML."""

    html: str

    @property
    def word(self):
        """The headline in capitals."""
        match = re.search(r"<h1><span[^>]*>.</span> ([^<]*)</h1>", self.html)
        return unescape(match[1]) if match else ""

    @property
    def headline(self):
        """Word, sentence and advice in one line."""
        section = re.search(
            r'<section class="headline">(.*?)</section>', self.html
        )
        paragraphs = re.findall(
            r'<p(?: class="advice")?>([^<]*)</p>', section[1]
        )
        return unescape(f"{self.word}: {' '.join(paragraphs)}")

    @property
    def shares(self):
        """Share of each bar by the name of its axis."""
        bars = re.findall(r'value="([\d.]+)" aria-label="([^"]+)"', self.html)
        return {name: float(value) for value, name in bars}

    @property
    def values(self):
        """Texts of the printed pose by axis."""
        pairs = re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", self.html)
        return {axis: unescape(text) for axis, text in pairs}

    @property
    def verdict(self):
        match = re.search(r"<b>verdict</b> ([^<]*)</p>", self.html)
        return match[1] if match else ""


class Witness:
    """Records every surface of the node with the time (s) at which something arrived."""

    def __init__(self, peer, domain, folder):
        self.states = []
        self.diagnostics = []
        self.transforms = []
        self.broadcasts = []
        self.pages = []
        node = peer.node
        self._subscribe(node, String, "/calibrator/progress", self._take_state)
        self._subscribe(
            node, TransformStamped, "/calibrator/extrinsic", self.transforms
        )

        node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take_diagnostics, 10
        )
        with contextlib.suppress(ImportError):
            from tf2_msgs.msg import TFMessage

            self._subscribe(node, TFMessage, "/tf_static", self.broadcasts)
        self._notes = folder / "watch.txt"
        environment = {
            "ROS_DOMAIN_ID": str(domain),
            "XDG_STATE_HOME": str(folder),
        }
        command = [
            sys.executable,
            "-m",
            "hand_eye_calib",
            "watch",
            "--web",
            "127.0.0.1:0",
        ]
        with self._notes.open("w") as notes:
            self._watch = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=notes,
                env=os.environ
                | environment
                | {"PYTHONPATH": os.pathsep.join(sys.path)},
            )
        threading.Thread(target=self._read_page, daemon=True).start()

    def _subscribe(self, node, kind, topic, target):
        take = (
            target
            if callable(target)
            else lambda data: target.append((time.time(), data))
        )
        node.create_subscription(kind, topic, take, LATCHED)

    def _take_state(self, text):
        state = state_of(text.data)
        assert state is not None, text.data
        self.states.append((time.time(), state))

    def _take_diagnostics(self, array):
        by_name = {
            status.name.rpartition(": ")[2]: status for status in array.status
        }
        self.diagnostics.append((time.time(), by_name))

    def _read_page(self):
        address = None
        while address is None:
            time.sleep(0.1)
            address = re.search(
                r"http://127.0.0.1:(\d+)/\?key=(\S+)", self._notes.read_text()
            )
        connection = http.client.HTTPConnection("127.0.0.1", int(address[1]))
        connection.request("GET", f"/events?key={address[2]}")
        events = connection.getresponse()
        while line := events.readline().decode():
            html = line.removeprefix("data: ").strip()
            if html:
                self.pages.append((time.time(), Page(html)))

    def close(self):
        self._watch.send_signal(signal.SIGINT)
        return self._watch.wait(60.0)


def newest(records, at_s):
    """Return time and newest record up to a time (s); None if there is none."""
    earlier = [record for record in records if record[0] <= at_s]
    return earlier[-1] if earlier else None


# ------------------------------------------------------------------- comparison


def contradictions(witness, start_s, end_s):
    """Yield (second, text) for each second at which two surfaces disagree."""
    for second in range(3, int(end_s - start_s)):
        now_s = start_s + second
        state_record = newest(witness.states, now_s)
        page_record = newest(witness.pages, now_s)
        if state_record is None or page_record is None:
            continue
        before = newest(witness.states, now_s - SETTLED_S)
        after = newest(witness.states, now_s + SETTLED_S)
        if before is None or not essence(before[1]) == essence(
            state_record[1]
        ) == essence(after[1]):
            # One surface may be ahead of another for a moment.
            continue
        texts = itertools.chain(
            compare_page(page_record[1], state_record[1]),
            compare_topics(witness, state_record[1], now_s),
        )
        for text in texts:
            yield second, text


def essence(state):
    """Return the part of a state that must be constant while surfaces are compared."""
    result = state.result
    progress = state.progress.progress if state.progress else None
    return (
        result and (result.verdict, tuple(result.pose.values())),
        progress and (progress.done, progress.sentence),
        state.headline,
        state.standing,
        state.extrinsic
        and (state.extrinsic.tf_static, state.extrinsic.contradicted),
        state.has_ended,
    )


def compare_page(page, state):
    """Yield contradictions between the page and the state of the node."""
    result = state.result
    progress = state.progress.progress if state.progress else None
    if (page.word == "DONE") and not (progress and progress.done):
        yield "the page is DONE, the state is not"
    if (
        progress
        and progress.done
        and page.word != "DONE"
        and not page.word.startswith(ALARMS)
    ):
        yield f"the state is done, the page is {page.word}"
    # The page of a node that is silent contains no headline of the node.
    if page.word != "SILENT" and page.headline != state.headline:
        yield f"the page says {page.headline!r}, ~/progress {state.headline!r}"
    yield from faults_of(view_of(state), state)
    verdict = result.verdict if result else "no result yet"
    if page.verdict != verdict:
        yield f"verdict {page.verdict!r} on the page, {verdict!r} in the state"
    if progress and progress.axes and not state.extrinsic.contradicted:
        yield from compare_bars(page, progress)
    if result and state.standing is not Standing.REFUTED:
        for axis in "xyz":
            value = result.pose[axis]
            text = page.values.get(axis, "")
            if value is not None and not text.startswith(f"{value:.3f} m"):
                yield f"{axis} is {text!r} on the page, {value:.3f} m in the state"
    motion_s = state.extrinsic.motion_s if state.extrinsic else 0.0
    rotation_deg = (
        max(state.extrinsic.rotation_deg.values(), default=0.0)
        if state.extrinsic
        else 0.0
    )
    is_early = motion_s < MIN_MOTION_S and rotation_deg < MIN_ROTATION_DEG
    if is_early and page.word in ("CHANGE THE MOTION", "DONE"):
        yield f"{page.word} after {motion_s:.0f} s and {rotation_deg:.0f} deg"


def compare_bars(page, progress):
    """Yield contradictions between the bars of the page and the progress of the session."""
    full = [share >= 1.0 for share in page.shares.values()]
    if progress.is_faulty:
        if any(page.shares.values()):
            yield "bars of faulty streams look good"
        return
    within = [
        progress.axes[key].sigma <= progress.axes[key].target
        for key in AXIS_KEYS.values()
    ]
    by_hand = [
        progress.axes[key].seconds_left == 0 for key in AXIS_KEYS.values()
    ]
    if any(
        a != (b or c) for a, b, c in zip(full, within, by_hand, strict=True)
    ):
        yield f"full bars {full}, axes within their target {within}"
    if progress.done and not all(full):
        yield "DONE with a bar that is not full"
    is_confirming = "onfirm" in page.headline
    if all(full) and page.word == "GO ON" and not is_confirming:
        yield f"all bars are full, and the page says {page.headline!r}"


def compare_topics(witness, state, now_s):
    """Yield contradictions between topics and the state of the node."""
    result = state.result
    transform = newest(witness.transforms, now_s)
    if result and transform and state.standing is Standing.CURRENT:
        T = matrix(transform[1])
        pose = [result.pose[axis] for axis in "xyz"]
        known = [axis for axis in range(3) if pose[axis] is not None]
        off_m = max(
            (abs(T[axis, 3] - pose[axis]) for axis in known), default=0.0
        )
        if off_m > 1e-6:
            yield f"~/extrinsic differs by {1e3 * off_m:.3g} mm from the state"
    diagnostics = newest(witness.diagnostics, now_s)
    if diagnostics and now_s - diagnostics[0] < 1.5 and state.progress:
        message = diagnostics[1]["progress"].message
        if message != state.headline:
            yield f"/diagnostics says {message!r}, ~/progress {state.headline!r}"
    if diagnostics and now_s - diagnostics[0] < 1.5 and result:
        status = diagnostics[1].get("extrinsic")
        values = values_of(status) if status else {}
        if values.get("verdict", result.verdict) != result.verdict:
            yield f"verdict {values['verdict']!r} on /diagnostics, {result.verdict!r} in the state"
    broadcast = newest(witness.broadcasts, now_s)
    sending = state.extrinsic.tf_static if state.extrinsic else Broadcast.OFF
    is_on = sending is Broadcast.ON
    # The last message of a latched topic stays, also after the node has withdrawn the transform.
    was_sent = sending in (Broadcast.ON, Broadcast.WITHDRAWN)
    if was_sent != bool(broadcast) and state.standing is Standing.CURRENT:
        yield f"/tf_static is {sending.value}, transform sent: {bool(broadcast)}"
    if is_on and broadcast and transform:
        (sent,) = broadcast[1].transforms
        if not np.allclose(matrix(sent), matrix(transform[1]), atol=1e-9):
            yield "/tf_static and ~/extrinsic differ"


def not_logged(witness, log):
    """Yield each headline of several seconds that the log does not contain.

    The log does not repeat a line that differs only in its numbers.
    """
    headlines = [state.headline for _, state in witness.states]
    logged = re.sub(NUMBERS, "", log)
    for headline, group in itertools.groupby(headlines):
        if (
            len(list(group)) >= 3
            and re.sub(NUMBERS, "", headline) not in logged
        ):
            yield f"not in the log: {headline}"


def view_of(state):
    """Return the view of ``watch`` for a state that has just arrived."""
    board = Board()
    board.take(state, 0.0)
    return board.view(0.5)


@dataclass(frozen=True)
class Promises:
    """Advice and times left in a session of a vehicle, compared with the rest of the session.

    Attributes
    ----------
    wait_s : float
        Time (s) from the moment when all axes are within their targets for good, to DONE.
    change_s : float
        Time (s) with CHANGE THE MOTION while the vehicle drives over ramps.
    n_times, n_good_times : int
        Seconds with a report of the time left before DONE, and those within a factor of two of the
        truth.
    """

    wait_s: float
    change_s: float
    n_times: int
    n_good_times: int

    def broken(self):
        """Yield the promises that were broken."""
        if not self.wait_s <= MAX_WAIT_S:
            yield f"DONE {self.wait_s:.0f} s after all axes are within their targets for good"
        if self.change_s:
            yield f"CHANGE THE MOTION for {self.change_s:.0f} s while ramps are driven"
        if self.n_good_times < MIN_GOOD_TIMES * self.n_times:
            yield f"{self.n_good_times} of {self.n_times} times left within a factor of two"


def promises(witness, start_s, end_s, flat_s):
    """Compare the advice and times left of a session with the rest of the session."""
    seconds = range(int(end_s - start_s))
    records = [newest(witness.states, start_s + second) for second in seconds]
    progress = {
        second: record[1].progress.progress
        for second, record in zip(seconds, records, strict=True)
        if record and record[1].progress
    }
    done_s = next(
        (second for second, state in progress.items() if state.done), math.inf
    )
    outside_s = 0
    change_s = 0
    ratios = []
    for second, state in progress.items():
        if second >= done_s:
            break
        if any(row.sigma > row.target for row in state.axes.values()):
            outside_s = second
        # The first ramp comes within a period, and takes 8 s.
        change_s += (
            state.will_not_get_there and second > flat_s + RAMP_PERIOD_S + 8.0
        )
        if math.isfinite(state.seconds_left):
            ratios.append(state.seconds_left / (done_s - second))
    n_good_times = sum(0.5 <= ratio <= 2.0 for ratio in ratios)
    return Promises(
        done_s - outside_s, float(change_s), len(ratios), n_good_times
    )


def end_contradictions(witness, log, folder):
    """Yield contradictions between the end of the session, its log and its files."""
    if "Traceback" in log:
        yield "a traceback in the log"
    last_s = {}
    for at_s, text in re.findall(r"\[WARN\] \[([\d.]+)\] (.*)", log):
        since_s = float(at_s) - last_s.get(text, -math.inf)
        if since_s < GOES_ON_S:
            yield f"logged again after {since_s:.0f} s: {text[:80]}"
        last_s[text] = float(at_s)
    page = witness.pages[-1][1]
    if page.word != "ENDED":
        yield f"the node has ended, the page says {page.word!r}"
    file = folder / "out" / "extrinsic.yaml"
    state = witness.states[-1][1]
    if state.result and not file.exists():
        yield "a result, but no file"
    if (
        file.exists()
        and witness.transforms
        and state.standing is Standing.CURRENT
    ):
        saved = load_result(file).T_parent_child
        if not np.allclose(saved, matrix(witness.transforms[-1][1]), atol=1e-9):
            yield "extrinsic.yaml and ~/extrinsic differ"


# ---------------------------------------------------------------------- session


def run(name, session, folder, seed):
    """Run one session; return the row of the table, and its contradictions."""
    streams, T_parent_child = simulated(session, seed)
    domain = free_domain()
    peer = Peer(domain)
    parameters = {
        "output_directory": folder / "out",
        "publish_tf": "true",
        **session.parameters,
    }
    if "installed" in parameters:
        wrong = T_parent_child @ se3.exp(
            np.array([0.15, 0.0, 0.0, 0.0, 0.0, math.radians(4.0)])
        )
        numbers = " ".join(f"{number:.6f}" for number in se3.xyz_rpy(wrong))
        parameters["installed"] = f"'{numbers}'"
    arguments = [f"-p {key}:={value}" for key, value in parameters.items()]
    witness = Witness(peer, domain, folder)
    node = NodeProcess(domain, folder / "node.log", arguments, fresh=True)
    end_load = others(session.load)
    try:
        peer.spin_until(
            lambda: witness.pages and witness.states, "the page and the node"
        )
        start_s = time.time() + START_S
        publishing = start_publishing(domain, streams, start_s, session)
        spin_to(peer, start_s + session.seconds + 4.0)
        end_s = time.time()
        publishing.join()
        last = witness.pages[-1][1]
        code, _ = node.stop(signal.SIGINT)
        spin_to(peer, end_s + 4.0)
    finally:
        end_load()
        node.kill()
        watch_code = witness.close()
        peer.close()
    problems = list(contradictions(witness, start_s, end_s))
    problems += [
        (math.inf, text)
        for text in end_contradictions(witness, node.log, folder)
    ]
    problems += [(math.inf, text) for text in not_logged(witness, node.log)]
    if session.vehicle:
        kept = promises(witness, start_s, end_s, session.flat_s)
        print(f"{name}, seed {seed}: {kept}")
        problems += [(math.inf, text) for text in kept.broken()]
    if code or watch_code:
        problems.append(
            (math.inf, f"exit codes {code} of the node, {watch_code} of watch")
        )
    if not re.match(session.ends_with, last.word):
        problems.append(
            (math.inf, f"ends with {last.headline!r}, not {session.ends_with}")
        )
    all_pages = "\n".join(page.html for _, page in witness.pages)
    if not re.search(session.must_appear, unescape(all_pages)):
        problems.append(
            (math.inf, f"the page has never displayed {session.must_appear!r}")
        )
    return row_of(witness, start_s, end_s, last, T_parent_child), problems


def spin_to(peer, end_s):
    """Process messages until a time (s), which may be later than the peer waits for an event."""
    while time.time() < end_s:
        next_s = min(time.time() + 10.0, end_s)
        peer.spin_until(lambda next_s=next_s: time.time() >= next_s, "a time")


def publish(streams, start_s, session):
    """Publish both streams in real time; main function of a process with real-time priority."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    peer = Peer(int(os.environ["ROS_DOMAIN_ID"]))
    publishers = peer.publishers(Odometry)
    peer.wait_matched(*publishers)
    rows = []
    for publisher, times_s, Ts, frame in (
        (publishers[0], streams.parent_s, streams.Ts_parent, "lidar"),
        (publishers[1], streams.child_s, streams.Ts_child, "camera"),
    ):
        rows += [
            (time_s, publisher, T, frame)
            for time_s, T in zip(times_s, Ts, strict=True)
        ]
    second = None
    for time_s, publisher, T, frame in sorted(rows, key=lambda row: row[0]):
        time.sleep(max(0.0, start_s + time_s - time.time()))
        stamp_ns = round((start_s + time_s) * 1e9)
        publisher.publish(message(Odometry, stamp_ns, T, frame))
        if time_s < session.second_publisher_s or frame == "lidar":
            continue
        if second is None:
            second = peer.publisher(Odometry, "child_odom")
        shifted = T @ se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.2]))
        second.publish(message(Odometry, stamp_ns + 20_000_000, shifted, frame))
    time.sleep(max(0.0, start_s + session.seconds - time.time()))
    peer.close()


def start_publishing(domain, streams, start_s, session):
    """Start the publisher's process."""
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=publish, args=(streams, start_s, session))
    process.start()
    return process


def row_of(witness, start_s, end_s, last, T_parent_child):
    """Return the row of the table, and the witness.

    The row contains the times of the first result and of DONE, the numbers of changes of verdict
    and headline, the error, and the last headline.
    """
    during = [
        (t, state) for t, state in witness.states if start_s <= t <= end_s
    ]
    first = next((t - start_s for t, state in during if state.result), math.nan)
    done = next(
        (
            t - start_s
            for t, s in during
            if s.progress and s.progress.progress.done
        ),
        math.nan,
    )
    verdicts = [state.result.verdict for _, state in during if state.result]
    flips = sum(a != b for a, b in itertools.pairwise(verdicts))
    words = [page.word for t, page in witness.pages if start_s <= t <= end_s]
    changes = sum(a != b for a, b in itertools.pairwise(words))
    error_mm = math.nan
    if witness.transforms:
        T = matrix(witness.transforms[-1][1])
        error_mm = 1e3 * float(np.linalg.norm(T[:3, 3] - T_parent_child[:3, 3]))
    return [
        f"{int(end_s - start_s)}",
        f"{first:.0f}",
        f"{done:.0f}",
        f"{flips}",
        f"{changes}",
        f"{error_mm:.0f}",
        last.headline[:70],
    ], witness


HEADINGS = [
    "seconds",
    "result at",
    "DONE at",
    "verdicts",
    "headlines",
    "error mm",
    "last headline",
]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    names = ", ".join(SESSIONS)
    parser.add_argument(
        "sessions",
        nargs="*",
        metavar="SESSION",
        help=f"all by default: {names}",
    )
    parser.add_argument(
        "--out", type=Path, help="directory for logs, pages and headlines"
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=SEED,
        help=f"seed of the first session's drive (default: {SEED})",
    )
    arguments = parser.parse_args()
    for name in arguments.sessions:
        if name not in SESSIONS:
            parser.error(f"no session {name!r}; the sessions are {names}")
    scratch_or_out = arguments.out.resolve() if arguments.out else None
    rows = []
    all_problems = []
    with tempfile.TemporaryDirectory() as scratch:
        for number, name in enumerate(SESSIONS):
            if arguments.sessions and name not in arguments.sessions:
                continue
            folder = (scratch_or_out or Path(scratch)) / f"session_{number}"
            folder.mkdir(parents=True, exist_ok=True)
            (row, witness), problems = run(
                name, SESSIONS[name], folder, arguments.seed + number
            )
            rows.append([name, *row, str(len(problems))])
            all_problems += [
                f"{name}, {second} s: {text}" for second, text in problems
            ]
            seen = dict.fromkeys(page.headline for _, page in witness.pages)
            (folder / "headlines.txt").write_text("\n".join(seen) + "\n")
            lines = [
                json.dumps([at_s, page.html]) for at_s, page in witness.pages
            ]
            (folder / "pages.jsonl").write_text("\n".join(lines) + "\n")
            print(name, row, *problems[:5], sep="\n   ", flush=True)
    show([Table("Live sessions", [*HEADINGS, "contradictions"], rows)])
    print("\n".join(all_problems))
    return bool(all_problems)


if __name__ == "__main__":
    sys.exit(main())
