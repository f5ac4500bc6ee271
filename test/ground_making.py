"""``PYTHONPATH=.:test python test/ground_making.py``: z, roll and pitch on a flat floor.

Simulated machines drive figures of eight in a yard, or up and down a street. Their lidars see the
ground by ray casting; their IMU measures accelerations. The errors are those of data sheets: ranges
2 cm (noise) and 1 cm (constant), beams 0.05 deg, accelerometer 2 mg.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.constants import g
from scipy.ndimage import gaussian_filter1d

import hand_eye_calib as hec
from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.core.results.calibration import Calibration
from reproduction.writing import TableRow, markdown_table

START_NS = 1_700_000_000_000_000_000
# Step of the simulation (s), and steps between two poses.
STEP_S = 0.01
POSE_STEPS = 10
# Longest range of a lidar (m).
REACH_M = 60.0
# Elevations of the rings (deg) by their number.
ELEVATIONS = {16: (-15.0, 15.0), 64: (-24.8, 2.0)}

# Lower and upper corners of what stands on the ground (m).
YARD = np.array(
    [
        [[-30, -26, -3], [30, -25, 5]],
        [[-30, 25, -3], [30, 26, 5]],
        [[-31, -26, -3], [-30, 26, 5]],
        [[30, -26, -3], [31, 26, 5]],
        [[20, 5, -3], [24, 8, 2.5]],
        [[-22, -14, -3], [-19, -9, 1.5]],
    ],
    dtype=float,
)
STREET = np.array(
    [[[-90, -12, -3], [90, -9, 8]], [[-90, 9, -3], [90, 12, 8]]], dtype=float
)


@dataclass(frozen=True)
class Place:
    """A place: slopes, bumps and noise of its ground, the boxes on it, and the course."""

    slope: float = 0.0
    crown: float = 0.0
    ramp: float = 0.0
    bump_m: float = 0.01
    grass_m: float = 0.0
    boxes: FloatArray | None = None
    is_road: bool = False


PLACES = {
    "yard": Place(boxes=YARD),
    "crown": Place(crown=0.02, boxes=STREET, is_road=True),
    "slope": Place(slope=np.tan(np.radians(3.0)), boxes=YARD),
    "grass": Place(grass_m=0.03, bump_m=0.03),
    "ramp": Place(ramp=np.tan(np.radians(6.0)), boxes=YARD),
}


class Machine:
    """A machine with two sensors; the truth, and what the sensors measure."""

    def __init__(
        self,
        seed: int,
        place: str = "yard",
        duration_s: float = 120.0,
        rings: int = 16,
        noise: float = 1.0,
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.place = PLACES[place]
        self.rings = rings
        self.noise = noise
        self.waves = self.rng.uniform(0.2, 0.8, (4, 2)) * self.rng.choice(
            [-1, 1], (4, 2)
        )
        self.phases = self.rng.uniform(0, 2 * np.pi, 4)
        self.times_s = np.arange(0.0, duration_s, STEP_S)
        self.T_base_parent = self._mount([0.8, 0.0, 1.4], 8.0)
        self.T_base_child = self._mount([-0.8, 0.4, 1.1], 8.0)
        self.T_parent_child = se3.inverse(self.T_base_parent) @ self.T_base_child
        self.Ts_world_base = self._drive()

    def _mount(self, position: list[float], tilt_deg: float) -> FloatArray:
        rng = self.rng
        angles = np.radians(
            [*rng.uniform(-tilt_deg, tilt_deg, 2), rng.uniform(-180, 180)]
        )
        offset = np.add(position, rng.uniform(-0.3, 0.3, 3))
        return se3.from_rotation_translation(se3.rotation_from_rpy(angles), offset)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the ground (m)."""
        place = self.place
        z = place.slope * x - place.crown * np.abs(y)
        z = z + place.ramp * np.clip(x - 2.0, 0.0, 8.0)
        for (along_x, along_y), phase in zip(self.waves, self.phases, strict=True):
            z = z + place.bump_m / 2 * np.sin(along_x * x + along_y * y + phase)
        return z

    def _drive(self) -> FloatArray:
        rng, t = self.rng, self.times_s
        if self.place.is_road:
            x, y = road_course(t, rng)
        else:
            slow = 2 * np.pi * t / rng.uniform(38, 46) + rng.uniform(0, 2 * np.pi)
            x = rng.uniform(11, 15) * np.sin(slow)
            y = rng.uniform(4.5, 5.8) * np.sin(2 * slow) + rng.uniform(-0.5, 0.5)
        heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
        cos, sin = np.cos(heading), np.sin(heading)
        corners = []
        # Front left, front right, rear left and rear right wheel (m).
        for ahead, left in ((0.8, 0.5), (0.8, -0.5), (-0.8, 0.5), (-0.8, -0.5)):
            corners.append(
                self.height(x + cos * ahead - sin * left, y + sin * ahead + cos * left)
            )
        front_left, front_right, rear_left, rear_right = corners
        pitch = (rear_left + rear_right - front_left - front_right) / 2 / 1.6
        roll = (front_left + rear_left - front_right - rear_right) / 2 / 1.0
        shaking = np.radians(0.15) * self.noise * _smooth_noise(rng, len(t), 60)
        sway = np.radians(0.15) * self.noise * _smooth_noise(rng, len(t), 60)
        angles = np.column_stack(
            [np.arctan(roll) + sway, np.arctan(pitch) + shaking, heading]
        )
        z = np.mean(corners, axis=0) + 0.004 * self.noise * _smooth_noise(
            rng, len(t), 40
        )
        return se3.from_rotation_translation(
            se3.rotation_from_rpy(angles), np.column_stack([x, y, z])
        )

    def _poses(self, T_base_sensor: FloatArray) -> FloatArray:
        """Poses of a sensor in its own world, with noise and drift."""
        Ts = self.Ts_world_base[::POSE_STEPS] @ T_base_sensor
        rng = self.rng
        steps = se3.inverse(Ts[:-1]) @ Ts[1:]
        sigmas = self.noise * np.repeat([0.001, np.radians(0.015)], 3)
        steps = steps @ se3.exp(sigmas * rng.standard_normal((len(steps), 6)))
        white = self.noise * np.repeat([0.004, np.radians(0.05)], 3)
        return se3.chained(steps) @ se3.exp(white * rng.standard_normal((len(Ts), 6)))

    def _trajectory(self, T_base_sensor: FloatArray, frame: str) -> Trajectory:
        stamps_ns = START_NS + np.round(self.times_s[::POSE_STEPS] * 1e9).astype(
            np.int64
        )
        return hec.Trajectory(
            stamps_ns, self._poses(T_base_sensor), frame, f"{frame}_odom"
        )

    @cached_property
    def parent(self) -> Trajectory:
        return self._trajectory(self.T_base_parent, "lidar")

    @cached_property
    def child(self) -> Trajectory:
        return self._trajectory(self.T_base_child, "rear")

    def clouds(
        self, T_base_sensor: FloatArray, stride: int = 10
    ) -> Iterator[tuple[int, FloatArray]]:
        """Yield the stamp (ns) and the points (N, 3) of each scan in the frame of a lidar."""
        rng = self.rng
        n_columns = 360 if self.rings == 16 else 256
        lowest, highest = ELEVATIONS[self.rings]
        elevations = np.radians(np.linspace(lowest, highest, self.rings))
        wrong_deg = self.noise * (rng.normal(0, 0.05, self.rings) + rng.normal(0, 0.05))
        bias_m = self.noise * rng.normal(0, 0.01)
        rays = _rays(elevations + np.radians(wrong_deg), n_columns)
        stated = _rays(elevations, n_columns)
        for row in range(0, len(self.times_s), POSE_STEPS * stride):
            T = self.Ts_world_base[row] @ T_base_sensor
            ranges = self._ranges(T[:3, 3], rays @ T[:3, :3].T)
            ranges = (
                ranges + bias_m + self.noise * 0.02 * rng.standard_normal(len(ranges))
            )
            hit = ranges < REACH_M
            yield (
                START_NS + round(self.times_s[row] * 1e9),
                ranges[hit, None] * stated[hit],
            )

    def _ranges(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        distances = self._ground_ranges(origin, directions)
        if self.place.boxes is None:
            return distances
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / directions
        for lower, upper in self.place.boxes:
            first, second = (lower - origin) * inverse, (upper - origin) * inverse
            near = np.minimum(first, second).max(axis=1)
            far = np.maximum(first, second).min(axis=1)
            is_hit = (near < far) & (near > 0.0) & (near < distances)
            distances = np.where(is_hit, near, distances)
        return distances

    def _ground_ranges(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Ranges of the ground along rays, by fixed-point iteration on its height."""
        down = directions[:, 2]
        falling = down < -0.01
        grass = self.place.grass_m * self.rng.standard_normal(len(down))
        clearance = origin[2] - self.height(origin[0], origin[1])
        distances = np.where(falling, clearance / np.maximum(-down, 0.01), REACH_M)
        for _ in range(12):
            distances = np.minimum(distances, REACH_M)
            points = origin + distances[:, None] * directions
            excess = points[:, 2] - self.height(points[:, 0], points[:, 1]) - grass
            change = excess / np.maximum(-down, 0.1)
            distances = np.where(
                falling, np.maximum(distances + 0.8 * change, 0.0), REACH_M
            )
        return distances

    def accelerations(self, T_base_sensor: FloatArray) -> tuple[IntArray, FloatArray]:
        """Stamps (ns) and specific forces (N, 3), m/s^2, of an accelerometer at 100 Hz."""
        rng = self.rng
        Ts = self.Ts_world_base @ T_base_sensor
        positions = Ts[:, :3, 3]
        accelerations = np.gradient(
            np.gradient(positions, STEP_S, axis=0), STEP_S, axis=0
        )
        forces = np.einsum(
            "nji,nj->ni", Ts[:, :3, :3], np.add(accelerations, [0, 0, g])
        )
        forces += self.noise * rng.normal(0, 0.02, 3)
        forces += self.noise * 0.2 * rng.standard_normal(forces.shape)
        return START_NS + np.round(self.times_s * 1e9).astype(np.int64), forces


def road_course(
    t: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Positions on a street: along one lane, a turn, and back along the other lane."""
    speed = 3.0
    straight_m = rng.uniform(56, 68)
    lane_m = rng.uniform(2.3, 2.8)
    step_m = speed * STEP_S
    is_turning = (speed * t) % (straight_m + np.pi * lane_m) > straight_m
    heading = (
        np.cumsum(gaussian_filter1d(is_turning.astype(float), 30)) * step_m / lane_m
    )
    x = np.cumsum(np.cos(heading)) * step_m - straight_m / 2
    return x, np.cumsum(np.sin(heading)) * step_m - lane_m


def _rays(elevations: FloatArray, n_columns: int) -> FloatArray:
    """Directions (rings * columns, 3) of the beams of a lidar."""
    azimuths = 2 * np.pi * np.arange(n_columns) / n_columns
    elevation, azimuth = np.meshgrid(elevations, azimuths, indexing="ij")
    level = np.cos(elevation)
    columns = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return np.stack(columns, axis=-1).reshape(-1, 3)


def _smooth_noise(rng: np.random.Generator, count: int, steps: int) -> FloatArray:
    """Noise of unit variance that is smooth over a number of steps."""
    noise = gaussian_filter1d(rng.standard_normal(count), steps)
    return noise / noise.std()


def calibrated_machine(machine: Machine, sensors: str = "lidars") -> Calibration:
    """Calibrate both lidars of a machine, or its lidar and its IMU, with the ground."""
    every = 10 if machine.rings == 16 else 20
    clouds = machine.clouds(machine.T_base_parent, every)
    if sensors == "lidars":
        parent = hec.ground_from_clouds(clouds, machine.parent)
        rear_clouds = machine.clouds(machine.T_base_child, every)
        child = hec.ground_from_clouds(rear_clouds, machine.child)
    else:
        parent = hec.ground_from_clouds(clouds, machine.parent, "gravity")
        accelerations = machine.accelerations(machine.T_base_child)
        child = hec.gravity_from_accelerations(*accelerations, machine.child)
    # The simulated poses have noise and drift, but no constant errors.
    return hec.calibrate_on_ground(
        machine.parent,
        machine.child,
        parent,
        child,
        parent_kind="exact",
        child_kind="exact",
    )


def score_of(place: str, sensors: str, rings: int, seeds: Sequence[int]) -> TableRow:
    """Return a row of the table: root mean square errors, and the share of covered errors."""
    all_errors = []
    all_sigmas = []
    n_joined = 0
    for seed in seeds:
        machine = Machine(seed, place, rings=rings)
        result = calibrated_machine(machine, sensors)
        ground = result.parts.get("ground")
        n_joined += ground is not None and ground.is_joined
        all_errors.append(
            se3.deviation(result.T_parent_child, machine.T_parent_child)[2:5]
        )
        all_sigmas.append(result.sigmas[2:5])
    errors = np.array(all_errors)
    sigmas = np.array(all_sigmas)
    z_m, roll, pitch = np.sqrt(np.mean(errors**2, axis=0))
    is_known = np.isfinite(sigmas)
    is_covered = np.abs(errors) < 1.645 * sigmas  # 90 % of a normal variable
    return {
        "place": place,
        "sensors": sensors,
        "rings": rings,
        "z (cm)": f"{100 * z_m:.1f}" if is_known[:, 0].all() else "-",
        "worst": f"{100 * np.abs(errors[:, 0]).max():.1f}"
        if is_known[:, 0].all()
        else "-",
        "roll (deg)": f"{np.degrees(roll):.3f}",
        "pitch (deg)": f"{np.degrees(pitch):.3f}",
        "90 % intervals cover": f"{is_covered[is_known].mean():.0%} of {is_known.sum()}",
        "joined": f"{n_joined} of {len(errors)}",
    }


def main() -> None:
    """Print a table of errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", nargs="+", default=["yard"], choices=PLACES)
    parser.add_argument("--sensors", default="lidars", choices=("lidars", "imu"))
    parser.add_argument("--rings", type=int, default=16, choices=ELEVATIONS)
    parser.add_argument("--seed", type=int, default=1, help="of the first machine")
    parser.add_argument("--machines", type=int, default=4)
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.machines)
    rows = []
    for place in arguments.places:
        rows.append(score_of(place, arguments.sensors, arguments.rings, seeds))
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
