"""Classes of simulated recordings, and the Cramer-Rao bound of each recording."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.coverage import motions
from reproduction.coverage.bound import Side, cramer_rao_bound
from reproduction.coverage.sensor_errors import (
    GaussMarkov,
    SensorErrors,
    Tail,
    draw,
    sigmas,
)

_START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class RecordingClass:
    """Motion, errors and size of the recordings of a class."""

    duration_s: float
    rate_hz: float
    parent: SensorErrors
    child: SensorErrors
    # ``motion(rng, duration_s)``.
    motion: Callable[[np.random.Generator, float], motions.Motion]
    # Length of the extrinsic's translation (m); its direction is drawn.
    lever_m: float = 0.4


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """Measured streams of a simulated recording, and the true extrinsic."""

    parent: Trajectory
    child: Trajectory
    T_parent_child: FloatArray
    # True poses and drawn errors of both sensors.
    sides: tuple[Side, Side]
    # Time between poses, s.
    dt: float

    def bound(self) -> FloatArray:
        """Return the Cramer-Rao bound (6, 6) of xi in ``X Exp(xi)`` under the true noise.

        xi is (rho, phi) in the child frame. The instants of jumps and bursts count as known.
        """
        return cramer_rao_bound(self.sides, self.sides[1].Ts, self.dt)


def simulate(
    kind: RecordingClass,
    seed: int | tuple[int, ...],
    T_parent_child: FloatArray | None = None,
    noise_seed: tuple[int, ...] | None = None,
) -> Simulated:
    """Simulate a recording of a class; equal seeds give equal recordings.

    The extrinsic is drawn if it is not given. A ``noise_seed`` changes the errors of the sensors,
    not the drive.
    """
    generators = np.random.default_rng(seed).spawn(4)
    motion_rng, mount_rng, parent_rng, child_rng = generators
    if noise_seed is not None:
        parent_rng, child_rng = np.random.default_rng(noise_seed).spawn(2)
    dt = 1.0 / kind.rate_hz
    n_poses = round(kind.duration_s * kind.rate_hz)
    times_s: FloatArray = dt * np.arange(n_poses, dtype=np.float64)
    motion = kind.motion(motion_rng, kind.duration_s)
    drawn = _mount(mount_rng, kind.lever_m)
    X = drawn if T_parent_child is None else T_parent_child

    Ts_parent = motion.at(times_s)
    Ts_child = Ts_parent @ X
    twists = motion.twists(times_s)
    to_child = se3.adjoint(se3.inverse(X))
    parent = draw(kind.parent, Ts_parent, twists, dt, parent_rng)
    child = draw(kind.child, Ts_child, twists @ to_child.T, dt, child_rng)
    child_poses = se3.inverse(_world(mount_rng)) @ child.poses
    stamps = stamps_ns(times_s)
    parent_side = Side(kind.parent, parent, Ts_parent, to_child)
    child_side = Side(kind.child, child, Ts_child, -np.eye(6))
    return Simulated(
        parent=Trajectory(stamps, parent.poses, "parent", "parent_odom"),
        child=Trajectory(stamps, child_poses, "child", "child_odom"),
        T_parent_child=X,
        sides=(parent_side, child_side),
        dt=dt,
    )


def stamps_ns(times_s: FloatArray) -> IntArray:
    """Return stamps (N,) for times (N,) since the start of a recording, s."""
    return _START_NS + np.round(times_s * 1e9).astype(np.int64)


def make(name: str, seed: int) -> Simulated:
    """Simulate the recording of a class with this seed."""
    class_number = sorted(CLASSES).index(name)
    return simulate(CLASSES[name], (seed, class_number))


def _mount(rng: np.random.Generator, lever_m: float) -> FloatArray:
    """Draw an extrinsic: any rotation, and a translation of this length that is mostly level."""
    direction = rng.standard_normal(3) * [1.0, 1.0, 0.5]
    length = np.linalg.norm(direction)
    rotation = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    return se3.from_rotation_translation(rotation, lever_m * direction / length)


def _world(rng: np.random.Generator) -> FloatArray:
    angles = rng.uniform(-1.0, 1.0, 3)
    rotation = Rotation.from_euler("ZYX", angles).as_matrix()
    position = rng.uniform(-2.0, 2.0, 3)
    return se3.from_rotation_translation(rotation, position)


def _slow(
    errors: SensorErrors,
    tau_s: float,
    metres: float,
    degrees: float,
    in_world: bool = False,
) -> SensorErrors:
    process = GaussMarkov(tau_s, sigmas(metres, degrees), in_world)
    return replace(errors, slow=(*errors.slow, process))


def _white(metres: float, degrees: float) -> SensorErrors:
    return SensorErrors(white=sigmas(metres, degrees))


def slam(tau_s: float, metres: float, degrees: float) -> SensorErrors:
    """Return the errors of a SLAM: white noise, and errors of the map (m, deg).

    ``tau_s`` is the correlation time of the errors of the map, s.
    """
    return _slow(_white(0.008, 0.03), tau_s, metres, degrees, in_world=True)


_MOCAP = _white(0.0005, 0.05)
_STEADY = _white(0.0004, 0.03)
_HAND = _white(0.003, 0.2)
_INS = _slow(_white(0.003, 0.01), 25.0, 0.12, 0.05, in_world=True)
LIDAR_ODOMETRY = replace(_white(0.01, 0.03), walk_by_metre=sigmas(0.006, 0.012))
VIO = replace(_white(0.0008, 0.03), walk=sigmas(0.004, 0.06))
_FLICKER = tuple(
    GaussMarkov(tau, sigmas(0.002, 0.12)) for tau in (0.1, 0.4, 1.6, 6.4, 25.6)
)

_hand = partial(RecordingClass, motion=motions.hand_held, lever_m=0.4)
_car = partial(RecordingClass, motion=motions.car, lever_m=1.5)
_agv = partial(RecordingClass, motion=motions.agv, lever_m=0.8)
_flat_agv = partial(RecordingClass, motion=motions.flat_agv, lever_m=0.8)
_drone = partial(RecordingClass, motion=motions.drone, lever_m=0.3)
_arm = partial(RecordingClass, motion=motions.arm, lever_m=0.15)

CLASSES = {
    "hand_white": _hand(
        duration_s=60.0,
        rate_hz=20.0,
        parent=_HAND,
        child=_white(0.004, 0.3),
    ),
    "hand_vio_walk": _hand(
        duration_s=90.0,
        rate_hz=20.0,
        parent=_MOCAP,
        child=VIO,
    ),
    "hand_gm_1s": _hand(
        duration_s=100.0,
        rate_hz=20.0,
        parent=_white(0.001, 0.08),
        child=_slow(_white(0.001, 0.08), 1.0, 0.005, 0.3),
    ),
    "hand_gm_03s_white": _hand(
        duration_s=80.0,
        rate_hz=20.0,
        parent=_slow(_HAND, 0.3, 0.003, 0.2),
        child=_slow(_HAND, 0.3, 0.006, 0.4),
    ),
    "hand_flicker": _hand(
        duration_s=80.0,
        rate_hz=15.0,
        parent=_MOCAP,
        child=replace(_white(0.001, 0.06), slow=_FLICKER),
    ),
    "car_ins_lidar": _car(
        duration_s=240.0,
        rate_hz=10.0,
        parent=_INS,
        child=LIDAR_ODOMETRY,
    ),
    "car_vo_scale": _car(
        duration_s=240.0,
        rate_hz=10.0,
        parent=_INS,
        child=replace(
            _white(0.004, 0.02),
            walk_by_metre=sigmas(0.004, 0.01),
            scale=(0.01, 40.0),
        ),
        lever_m=1.2,
    ),
    "car_jitter": _car(
        duration_s=180.0,
        rate_hz=10.0,
        parent=replace(_INS, jitter_s=0.001),
        child=replace(LIDAR_ODOMETRY, jitter_s=0.004),
        lever_m=1.0,
    ),
    "car_lever": _car(
        duration_s=200.0,
        rate_hz=10.0,
        parent=replace(_white(0.01, 0.08), walk=sigmas(0.01, 0.01)),
        child=replace(_white(0.01, 0.08), walk_by_metre=sigmas(0.004, 0.008)),
        lever_m=5.0,
    ),
    "car_two_slams": _car(
        duration_s=250.0,
        rate_hz=10.0,
        parent=slam(12.0, 0.05, 0.08),
        child=slam(8.0, 0.08, 0.12),
    ),
    "agv_ramps": _agv(
        duration_s=240.0,
        rate_hz=10.0,
        parent=replace(_white(0.001, 0.01), walk_by_metre=sigmas(0.004, 0.05)),
        child=_slow(_white(0.004, 0.04), 3.0, 0.01, 0.06, in_world=True),
    ),
    "agv_long": _agv(
        duration_s=1200.0,
        rate_hz=2.5,
        parent=replace(_white(0.002, 0.02), walk_by_metre=sigmas(0.004, 0.05)),
        child=_slow(_white(0.005, 0.05), 20.0, 0.015, 0.08, in_world=True),
    ),
    "drone_gnss_vio": _drone(
        duration_s=150.0,
        rate_hz=20.0,
        parent=_slow(_white(0.004, 0.05), 15.0, 0.15, 0.2, in_world=True),
        child=VIO,
        lever_m=0.2,
    ),
    "drone_rotation_1deg": _drone(
        duration_s=100.0,
        rate_hz=20.0,
        parent=_white(0.002, 1.0),
        child=replace(_white(0.003, 0.3), walk=sigmas(0.002, 0.02)),
    ),
    "arm_target": _arm(
        duration_s=150.0,
        rate_hz=10.0,
        parent=_slow(_white(0.0001, 0.005), 5.0, 0.0003, 0.02),
        child=_slow(
            SensorErrors(
                white=sigmas(
                    np.array([0.0008, 0.0008, 0.003]),
                    np.array([0.3, 0.3, 0.06]),
                )
            ),
            1.0,
            0.0005,
            0.06,
        ),
    ),
    "hand_t3": _hand(
        duration_s=60.0,
        rate_hz=20.0,
        parent=_STEADY,
        child=replace(_white(0.003, 0.2), tail=Tail("student", factor=3.0)),
    ),
    "hand_spikes": _hand(
        duration_s=60.0,
        rate_hz=20.0,
        parent=_STEADY,
        child=replace(_white(0.003, 0.2), tail=Tail("spikes", 0.05, 20.0)),
    ),
    "hand_bursts": _hand(
        duration_s=90.0,
        rate_hz=20.0,
        parent=replace(_STEADY, walk=sigmas(0.001, 0.02)),
        child=replace(_white(0.002, 0.15), tail=Tail("bursts", 0.15, 10.0)),
    ),
    "drone_anisotropic": _drone(
        duration_s=120.0,
        rate_hz=20.0,
        parent=SensorErrors(
            white=sigmas(
                np.array([0.002, 0.002, 0.012]), np.array([0.3, 0.1, 0.1])
            )
        ),
        child=SensorErrors(
            white=sigmas(
                np.array([0.015, 0.003, 0.003]), np.array([0.1, 0.1, 0.5])
            ),
            walk=sigmas(
                np.array([0.004, 0.001, 0.001]), np.array([0.01, 0.01, 0.04])
            ),
        ),
    ),
    "hand_mixture_30s": _hand(
        duration_s=30.0,
        rate_hz=30.0,
        parent=_white(0.001, 0.08),
        child=_slow(
            replace(
                _white(0.002, 0.1), walk=sigmas(0.003, 0.05), jumps_per_s=0.2
            ),
            2.0,
            0.002,
            0.1,
        ),
    ),
    "drone_two_vios": _drone(
        duration_s=140.0,
        rate_hz=15.0,
        parent=VIO,
        child=replace(
            _white(0.001, 0.04), walk=sigmas(0.006, 0.05), scale=(0.005, 20.0)
        ),
        lever_m=0.1,
    ),
    "flat_agv": _flat_agv(
        duration_s=200.0,
        rate_hz=10.0,
        parent=replace(_white(0.002, 0.02), walk_by_metre=sigmas(0.004, 0.05)),
        child=replace(_white(0.005, 0.05), walk_by_metre=sigmas(0.003, 0.03)),
    ),
}

# Classes whose motion does not determine all six degrees of freedom: results must be refused.
REFUSED = ("flat_agv",)
