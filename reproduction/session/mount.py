"""The mount monitor: false alarms and delays until a shift is seen.

Simulated recordings of ten minutes follow each other, with one extrinsic; the motion and the errors
are drawn anew for each. A shift is put into the child's poses.
"""

import copy
import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.arrays import FloatArray
from hand_eye_calib.engine.offline import calibrate
from hand_eye_calib.geometry import se3
from hand_eye_calib.live.monitor import MountMonitor
from hand_eye_calib.pairing.synchronise import PosePairs, synchronise
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.recordings import Rig

PIECE_S = 600.0
# Each of these for as many hours as the others. Not the flat floor, which hides the height, and not
# the recordings with a jump every five seconds.
WATCHED = tuple(name for name in CLASSES if name not in ("flat_agv", "hand_mixture_30s"))

SHIFTED = {
    "hand-held": ("hand_gm_1s", "hand_vio_walk"),
    "AGV": ("agv_ramps", "agv_long"),
    "car": ("car_ins_lidar", "car_two_slams"),
}
SHIFTS = {"0.5 deg": np.radians(0.5), "2 deg": np.radians(2.0), "1 cm": 0.01, "5 cm": 0.05}
_BEFORE_S, _AFTER_S = 900.0, 1800.0

# The monitor takes no more poses a second than this.
_RATE_HZ = 10.0

_SECOND_NS = 1_000_000_000
_MOUNT_SEED = 11


@dataclass(frozen=True)
class Watched:
    """What the monitor said in so many hours without any shift."""

    name: str
    hours: float
    alarms: int
    long_run: float
    visible: FloatArray


@dataclass(frozen=True)
class Delay:
    """Seconds of driving until a shift was seen; infinite if it was not within half an hour."""

    kind: str
    size: str
    seconds: float
    # The smallest shift along or about that direction that ten minutes of motion would show, as the
    # monitor says beforehand, over the shift.
    announced: float


def pieces(name: str, seed: int, X: FloatArray, duration_s: float) -> Iterator[PosePairs]:
    """Synchronised poses of a class that follow each other, with this extrinsic."""
    rate_hz = min(CLASSES[name].rate_hz, _RATE_HZ)
    kind = dataclasses.replace(CLASSES[name], duration_s=min(duration_s, PIECE_S), rate_hz=rate_hz)
    for number in range(round(duration_s / kind.duration_s)):
        made = simulate(kind, (_MOUNT_SEED, seed, number, sorted(CLASSES).index(name)), X)
        pairs = synchronise(made.parent, made.child, 0.5)
        # Half a minute between the pieces: nothing runs across.
        yield shifted_in_time(pairs, round(number * (kind.duration_s + 30.0)) * _SECOND_NS)


def shifted_in_time(pairs: PosePairs, by_ns: int) -> PosePairs:
    """The same motion at another time."""
    return PosePairs(pairs.stamps_ns + by_ns, pairs.Ts_pw_p, pairs.Ts_cw_c)


def mount(name: str, seed: int) -> FloatArray:
    """An extrinsic of a class."""
    kind = dataclasses.replace(CLASSES[name], duration_s=10.0)
    return simulate(kind, (_MOUNT_SEED, seed)).T_parent_child


def feed(monitor: MountMonitor, pairs: PosePairs, chunk_s: float = 1.0) -> None:
    """Give poses to the monitor as they come in, a second at a time."""
    for _ in _fed(monitor, pairs, chunk_s):
        pass


def _fed(monitor: MountMonitor, pairs: PosePairs, chunk_s: float = 1.0) -> Iterator[None]:
    edges = np.flatnonzero(np.diff(pairs.stamps_ns // round(chunk_s * _SECOND_NS), prepend=-1))
    for first, last in zip(edges, [*edges[1:], len(pairs)], strict=True):
        monitor.add(pairs[first:last])
        yield


def false_alarms(name: str, hours: float) -> Watched:
    """Watch a mount that does not move."""
    X = mount(name, 0)
    monitor = MountMonitor(X, np.zeros((6, 6)))
    for pairs in pieces(name, 0, X, 3600.0 * hours):
        feed(monitor, pairs)
    return Watched(name, hours, monitor.alarms, monitor.long_run, monitor.visible(600.0))


def real_loop(rig: Rig, name: str, hours: float) -> Watched:
    """Play a recording in a loop against the answer of its own whole, with its covariance."""
    recording = rig.recordings[name]
    result = calibrate(recording.parent, recording.child, method="auto", **rig.options)
    child = recording.child.scaled(result.scale).shifted(result.time_offset_s)
    pairs = synchronise(recording.parent, child, 0.5)
    duration_ns = int(pairs.stamps_ns[-1] - pairs.stamps_ns[0]) + 30 * _SECOND_NS
    monitor = MountMonitor(result.T_parent_child, result.covariance)
    for number in range(max(round(hours * 3600e9 / duration_ns), 1)):
        feed(monitor, shifted_in_time(pairs, number * duration_ns))
    visible = monitor.visible(600.0)
    return Watched(f"{rig.name} {name}", hours, monitor.alarms, monitor.long_run, visible)


def delays(kind: str, seed: int) -> list[Delay]:
    """How long each shift takes to be seen, along or about a direction drawn for each."""
    names = SHIFTED[kind]
    name = names[seed % len(names)]
    X = mount(name, seed)
    before = MountMonitor(X, np.zeros((6, 6)))
    parts = list(pieces(name, 100 + seed, X, _BEFORE_S + _AFTER_S))
    n_before = round(_BEFORE_S / PIECE_S)
    for pairs in parts[:n_before]:
        feed(before, pairs)
    rng = np.random.default_rng(seed)
    return [_delay(kind, size, copy.deepcopy(before), parts[n_before:], X, rng) for size in SHIFTS]


def _delay(
    kind: str,
    size: str,
    monitor: MountMonitor,
    parts: list[PosePairs],
    X: FloatArray,
    rng: np.random.Generator,
) -> Delay:
    axis = int(rng.integers(3)) + (3 if size.endswith("deg") else 0)
    in_parent = np.eye(6)[axis] * SHIFTS[size]
    xi = np.kron(np.eye(2), X[:3, :3].T) @ in_parent
    announced = float(monitor.visible(600.0)[axis] / SHIFTS[size])
    before = monitor.seconds
    alarms = monitor.alarms
    for pairs in parts:
        moved = PosePairs(pairs.stamps_ns, pairs.Ts_pw_p, pairs.Ts_cw_c @ se3.exp(xi))
        for _ in _fed(monitor, moved):
            if monitor.alarms > alarms:
                return Delay(kind, size, float(monitor.seconds - before), announced)
    return Delay(kind, size, np.inf, announced)
