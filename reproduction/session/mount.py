"""Study of the mount monitor: false alarms, and delays until a shift is detected.

Simulated recordings of ten minutes follow each other. All have the same extrinsic, but new motion
and new errors. A shift of the mount is a change of the child's poses.
"""

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.pairing.motion_pairs import PosePairs, synchronise
from hand_eye_calib.extras.mount.monitor import MountMonitor
from reproduction.coverage.classes import CLASSES, simulate
from reproduction.writing import markdown_table, triple

# Duration of a recording (s).
PIECE_S = 600.0
# Classes without a shift. The flat floor is left out, because it does not determine the height, and
# so is the class with a jump every five seconds.
WATCHED = tuple(
    name for name in CLASSES if name not in ("flat_agv", "hand_mixture_30s")
)

# Classes with a shift, by motion.
SHIFTED = {
    "hand-held": ("hand_gm_1s", "hand_vio_walk"),
    "AGV": ("agv_ramps", "agv_long"),
    "car": ("car_ins_lidar", "car_two_slams"),
}
# Sizes of shifts (m or rad).
SHIFTS = {
    "0.5 deg": np.radians(0.5),
    "2 deg": np.radians(2.0),
    "1 cm": 0.01,
    "5 cm": 0.05,
}
# Durations before and after a shift (s).
_BEFORE_S = 900.0
_AFTER_S = 1800.0

# Largest rate of the poses for the monitor (Hz).
_RATE_HZ = 10.0

_SECOND_NS = 1_000_000_000
_MOUNT_SEED = 11


@dataclass(frozen=True)
class Watched:
    """Output of the monitor for a mount without a shift."""

    # Class of the recordings, and their duration (hours).
    name: str
    hours: float
    # Number of false alarms.
    alarms: int
    # Shift (6,) that the monitor would detect in ten minutes (m, rad).
    visible: FloatArray


@dataclass(frozen=True)
class Delay:
    """Delay until the monitor detected a shift of the mount."""

    # Motion, and size of the shift.
    kind: str
    size: str
    # Motion (s) from the shift to its detection; infinite without detection in half an hour.
    seconds: float
    # Smallest shift on this axis that the monitor declared detectable in ten minutes, divided by
    # the shift.
    announced: float


def _pieces(
    name: str, seed: int, X: FloatArray, duration_s: float
) -> Iterator[PosePairs]:
    """Yield the synchronised poses of recordings of a class that follow each other."""
    rate_hz = min(CLASSES[name].rate_hz, _RATE_HZ)
    kind = dataclasses.replace(
        CLASSES[name], duration_s=min(duration_s, PIECE_S), rate_hz=rate_hz
    )
    class_number = sorted(CLASSES).index(name)
    for number in range(round(duration_s / kind.duration_s)):
        made = simulate(kind, (_MOUNT_SEED, seed, number, class_number), X)
        pairs = synchronise(made.parent, made.child, 0.5)
        # The pieces are half a minute apart, so that no motion spans two pieces.
        later_ns = round(number * (kind.duration_s + 30.0)) * _SECOND_NS
        yield PosePairs(
            pairs.stamps_ns + later_ns, pairs.Ts_pw_p, pairs.Ts_cw_c
        )


def _mount(name: str, seed: int) -> FloatArray:
    kind = dataclasses.replace(CLASSES[name], duration_s=10.0)
    return simulate(kind, (_MOUNT_SEED, seed)).T_parent_child


def _fed(monitor: MountMonitor, pairs: PosePairs) -> Iterator[None]:
    """Pass poses to the monitor second by second, as in a session; yield after each second."""
    edges = np.flatnonzero(np.diff(pairs.stamps_ns // _SECOND_NS, prepend=-1))
    for first, last in zip(edges, [*edges[1:], len(pairs)], strict=True):
        monitor.add(pairs[first:last])
        yield


def false_alarms(name: str, hours: float) -> Watched:
    """Run the monitor on a mount that does not move."""
    X = _mount(name, 0)
    monitor = MountMonitor(X, np.zeros((6, 6)))
    for pairs in _pieces(name, 0, X, 3600.0 * hours):
        for _ in _fed(monitor, pairs):
            pass
    return Watched(
        name, hours, int(monitor.alarm is not None), monitor.visible(600.0)
    )


def alarm_table(watched: Sequence[Watched]) -> str:
    """Return a table of false alarms, and of shifts that cause an alarm, by class of motion."""
    groups: dict[str, list[Watched]] = {}
    for drive in watched:
        groups.setdefault(drive.name.partition("_")[0], []).append(drive)
    rows = []
    for name, group in groups.items():
        visible = np.max([drive.visible for drive in group], axis=0)
        rows.append(
            {
                "recordings": f"{name} ({len(group)})",
                "hours": f"{sum(drive.hours for drive in group):g}",
                "alarms": sum(drive.alarms for drive in group),
                "x, y, z (cm)": triple(visible[:3], 100.0, ".2g"),
                "about x, y, z (deg)": triple(
                    np.degrees(visible[3:]), form=".2g"
                ),
            }
        )
    hours = sum(drive.hours for drive in watched)
    alarms = sum(drive.alarms for drive in watched)
    return (
        f"{alarms} alarms in {hours:g} h of motion without a shift. The last columns contain the "
        "shift that is detected within ten minutes of this motion, nine times out of ten."
        f"\n\n{markdown_table(rows)}"
    )


def delays(kind: str, seed: int) -> list[Delay]:
    """Return the delay until each shift is detected, along or about a random axis."""
    names = SHIFTED[kind]
    name = names[seed % len(names)]
    X = _mount(name, seed)
    before = MountMonitor(X, np.zeros((6, 6)))
    parts = list(_pieces(name, 100 + seed, X, _BEFORE_S + _AFTER_S))
    n_before = round(_BEFORE_S / PIECE_S)
    for pairs in parts[:n_before]:
        for _ in _fed(before, pairs):
            pass
    rng = np.random.default_rng(seed)
    delays_of_kind = []
    for size, shift in SHIFTS.items():
        axis = int(rng.integers(3))
        if size.endswith("deg"):
            axis += 3
        to_child = np.kron(np.eye(2), X[:3, :3].T)
        xi = to_child @ (np.eye(6)[axis] * shift)
        announced = float(before.visible(600.0)[axis] / shift)
        seconds = _seconds_until_seen(
            copy.deepcopy(before), parts[n_before:], xi
        )
        delays_of_kind.append(Delay(kind, size, seconds, announced))
    return delays_of_kind


def _seconds_until_seen(
    monitor: MountMonitor, parts: list[PosePairs], xi: FloatArray
) -> float:
    before = monitor.seconds
    for pairs in parts:
        moved = PosePairs(
            pairs.stamps_ns, pairs.Ts_pw_p, pairs.Ts_cw_c @ se3.exp(xi)
        )
        for _ in _fed(monitor, moved):
            if monitor.alarm is not None:
                return float(monitor.seconds - before)
    return float("inf")


def delay_table(delays_measured: Sequence[Delay]) -> str:
    """Return a table with a row for each motion and shift."""
    rows = []
    for kind, size in dict.fromkeys(
        (delay.kind, delay.size) for delay in delays_measured
    ):
        delays = [
            delay
            for delay in delays_measured
            if (delay.kind, delay.size) == (kind, size)
        ]
        seconds = np.array([delay.seconds for delay in delays])
        # Shifts that the monitor had declared detectable in ten minutes.
        is_announced = np.array([delay.announced <= 1.0 for delay in delays])
        announced = seconds[is_announced]
        others = seconds[~is_announced]
        words = ["-", "-"]
        if len(announced):
            quantiles = np.quantile(announced, [0.5, 0.9], method="higher")
            words = [
                f"{value:.0f}" if np.isfinite(value) else "> 1800"
                for value in quantiles
            ]
        rows.append(
            {
                "motion": kind,
                "shift": size,
                "said to be seen": f"{len(announced)} of {len(delays)}",
                "median (s)": words[0],
                "90 % (s)": words[1],
                "others seen": f"{int(np.isfinite(others).sum())} of {len(others)}",
            }
        )
    return markdown_table(rows)
