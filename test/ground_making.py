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
        self.T_parent_child = (
            se3.inverse(self.T_base_parent) @ self.T_base_child
        )
        self.Ts_world_base = self._drive()

    def _mount(self, position: list[float], tilt_deg: float) -> FloatArray:
        rng = self.rng
        roll_deg, pitch_deg = rng.uniform(-tilt_deg, tilt_deg, 2)
        yaw_deg = rng.uniform(-180, 180)
        angles = np.radians([roll_deg, pitch_deg, yaw_deg])
        rotation = se3.rotation_from_rpy(angles)
        offset = np.add(position, rng.uniform(-0.3, 0.3, 3))
        return se3.from_rotation_translation(rotation, offset)

    def height(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the ground (m)."""
        place = self.place
        z = place.slope * x - place.crown * np.abs(y)
        on_ramp_m = np.clip(x - 2.0, 0.0, 8.0)
        z = z + place.ramp * on_ramp_m
        amplitude_m = place.bump_m / 2
        for (along_x, along_y), phase in zip(
            self.waves, self.phases, strict=True
        ):
            angle = along_x * x + along_y * y + phase
            z = z + amplitude_m * np.sin(angle)
        return z

    def _drive(self) -> FloatArray:
        rng = self.rng
        t = self.times_s
        if self.place.is_road:
            x, y = road_course(t, rng)
        else:
            x, y = yard_course(t, rng)
        heading = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
        heights = self._wheel_heights(x, y, heading)
        front_left, front_right, rear_left, rear_right = heights
        pitch = (rear_left + rear_right - front_left - front_right) / 2 / 1.6
        roll = (front_left + rear_left - front_right - rear_right) / 2 / 1.0

        amplitude = np.radians(0.15) * self.noise
        shaking = amplitude * _smooth_noise(rng, len(t), 60)
        sway = amplitude * _smooth_noise(rng, len(t), 60)
        heave_m = 0.004 * self.noise * _smooth_noise(rng, len(t), 40)
        roll_angle = np.arctan(roll) + sway
        pitch_angle = np.arctan(pitch) + shaking
        angles = np.column_stack([roll_angle, pitch_angle, heading])
        rotations = se3.rotation_from_rpy(angles)
        z = np.mean(heights, axis=0) + heave_m
        positions = np.column_stack([x, y, z])
        return se3.from_rotation_translation(rotations, positions)

    def _poses(self, T_base_sensor: FloatArray) -> FloatArray:
        """Poses of a sensor in its own world, with noise and drift."""
        rng = self.rng
        Ts = self.Ts_world_base[::POSE_STEPS] @ T_base_sensor
        steps = se3.inverse(Ts[:-1]) @ Ts[1:]
        drift_sigmas = self.noise * np.repeat([0.001, np.radians(0.015)], 3)
        drift = drift_sigmas * rng.standard_normal((len(steps), 6))
        drifting = se3.chained(steps @ se3.exp(drift))
        white_sigmas = self.noise * np.repeat([0.004, np.radians(0.05)], 3)
        white = white_sigmas * rng.standard_normal((len(Ts), 6))
        return drifting @ se3.exp(white)

    def _trajectory(self, T_base_sensor: FloatArray, frame: str) -> Trajectory:
        stamps_ns = START_NS + np.round(
            self.times_s[::POSE_STEPS] * 1e9
        ).astype(np.int64)
        return hec.Trajectory(
            stamps_ns, self._poses(T_base_sensor), frame, f"{frame}_odom"
        )

    @cached_property
    def parent(self) -> Trajectory:
        return self._trajectory(self.T_base_parent, "lidar")

    @cached_property
    def child(self) -> Trajectory:
        return self._trajectory(self.T_base_child, "rear")

    def _wheel_heights(
        self, x: FloatArray, y: FloatArray, heading: FloatArray
    ) -> list[FloatArray]:
        """Heights of the ground under the wheels: front left and right, rear left and right."""
        cos = np.cos(heading)
        sin = np.sin(heading)
        heights = []
        # Positions of the wheels in the frame of the base (m).
        for ahead, left in ((0.8, 0.5), (0.8, -0.5), (-0.8, 0.5), (-0.8, -0.5)):
            wheel_x = x + cos * ahead - sin * left
            wheel_y = y + sin * ahead + cos * left
            heights.append(self.height(wheel_x, wheel_y))
        return heights

    def clouds(
        self, T_base_sensor: FloatArray, stride: int = 10
    ) -> Iterator[tuple[int, FloatArray]]:
        """Yield the stamp (ns) and the points (N, 3) of each scan in the frame of a lidar."""
        rng = self.rng
        n_columns = 360 if self.rings == 16 else 256
        lowest, highest = ELEVATIONS[self.rings]
        elevations = np.radians(np.linspace(lowest, highest, self.rings))
        ring_errors_deg = rng.normal(0, 0.05, self.rings)
        common_error_deg = rng.normal(0, 0.05)
        elevation_errors_deg = self.noise * (ring_errors_deg + common_error_deg)
        bias_m = self.noise * rng.normal(0, 0.01)
        stated_rays = _rays(elevations, n_columns)
        true_rays = _rays(
            elevations + np.radians(elevation_errors_deg), n_columns
        )

        for row in range(0, len(self.times_s), POSE_STEPS * stride):
            T = self.Ts_world_base[row] @ T_base_sensor
            ranges = self._ranges(T[:3, 3], true_rays @ T[:3, :3].T)
            white_m = self.noise * 0.02 * rng.standard_normal(len(ranges))
            ranges = ranges + bias_m + white_m
            is_hit = ranges < REACH_M
            points = ranges[is_hit, None] * stated_rays[is_hit]
            stamp_ns = START_NS + round(self.times_s[row] * 1e9)
            yield stamp_ns, points

    def _ranges(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        distances = self._ground_ranges(origin, directions)
        if self.place.boxes is None:
            return distances
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / directions
        for lower, upper in self.place.boxes:
            first, second = (
                (lower - origin) * inverse,
                (upper - origin) * inverse,
            )
            near = np.minimum(first, second).max(axis=1)
            far = np.maximum(first, second).min(axis=1)
            is_hit = (near < far) & (near > 0.0) & (near < distances)
            distances = np.where(is_hit, near, distances)
        return distances

    def _ground_ranges(
        self, origin: FloatArray, directions: FloatArray
    ) -> FloatArray:
        """Ranges of the ground along rays, by fixed-point iteration on its height."""
        down = directions[:, 2]
        is_falling = down < -0.01
        grass = self.place.grass_m * self.rng.standard_normal(len(down))
        clearance = origin[2] - self.height(origin[0], origin[1])
        distances = clearance / np.maximum(-down, 0.01)
        distances = np.where(is_falling, distances, REACH_M)
        slowest_fall = np.maximum(-down, 0.1)
        for _ in range(12):
            distances = np.minimum(distances, REACH_M)
            points = origin + distances[:, None] * directions
            x, y, z = points.T
            excess = z - self.height(x, y) - grass
            change = excess / slowest_fall
            distances = np.maximum(distances + 0.8 * change, 0.0)
            distances = np.where(is_falling, distances, REACH_M)
        return distances

    def accelerations(
        self, T_base_sensor: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Stamps (ns) and specific forces (N, 3), m/s^2, of an accelerometer at 100 Hz."""
        rng = self.rng
        Ts = self.Ts_world_base @ T_base_sensor
        rotations = Ts[:, :3, :3]
        positions = Ts[:, :3, 3]
        velocities = np.gradient(positions, STEP_S, axis=0)
        accelerations = np.gradient(velocities, STEP_S, axis=0)
        forces_in_world = np.add(accelerations, [0, 0, g])
        forces = np.einsum("nji,nj->ni", rotations, forces_in_world)
        forces += self.noise * rng.normal(0, 0.02, 3)
        forces += self.noise * 0.2 * rng.standard_normal(forces.shape)
        stamps_ns = START_NS + np.round(self.times_s * 1e9).astype(np.int64)
        return stamps_ns, forces


def yard_course(
    t: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Positions on a figure of eight."""
    period_s = rng.uniform(38, 46)
    start = rng.uniform(0, 2 * np.pi)
    phase = 2 * np.pi * t / period_s + start
    length_m = rng.uniform(11, 15)
    width_m = rng.uniform(4.5, 5.8)
    offset_m = rng.uniform(-0.5, 0.5)
    x = length_m * np.sin(phase)
    y = width_m * np.sin(2 * phase) + offset_m
    return x, y


def road_course(
    t: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Positions on a street: along one lane, a turn, and back along the other lane."""
    speed = 3.0
    straight_m = rng.uniform(56, 68)
    lane_m = rng.uniform(2.3, 2.8)
    step_m = speed * STEP_S
    round_m = straight_m + np.pi * lane_m
    is_turning = (speed * t) % round_m > straight_m
    turning = gaussian_filter1d(is_turning.astype(float), 30)
    heading = np.cumsum(turning) * step_m / lane_m
    x = np.cumsum(np.cos(heading)) * step_m
    y = np.cumsum(np.sin(heading)) * step_m
    return x - straight_m / 2, y - lane_m


def _rays(elevations: FloatArray, n_columns: int) -> FloatArray:
    """Directions (rings * columns, 3) of the beams of a lidar."""
    azimuths = 2 * np.pi * np.arange(n_columns) / n_columns
    elevation, azimuth = np.meshgrid(elevations, azimuths, indexing="ij")
    level = np.cos(elevation)
    x = level * np.cos(azimuth)
    y = level * np.sin(azimuth)
    z = np.sin(elevation)
    directions = np.stack([x, y, z], axis=-1)
    return directions.reshape(-1, 3)


def _smooth_noise(
    rng: np.random.Generator, count: int, steps: int
) -> FloatArray:
    """Noise of unit variance that is smooth over a number of steps."""
    noise = gaussian_filter1d(rng.standard_normal(count), steps)
    return noise / noise.std()


def calibrated_machine(
    machine: Machine, sensors: str = "lidars"
) -> Calibration:
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


def score_of(
    place: str, sensors: str, rings: int, seeds: Sequence[int]
) -> TableRow:
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
    parser.add_argument(
        "--sensors", default="lidars", choices=("lidars", "imu")
    )
    parser.add_argument("--rings", type=int, default=16, choices=ELEVATIONS)
    parser.add_argument(
        "--seed", type=int, default=1, help="of the first machine"
    )
    parser.add_argument("--machines", type=int, default=4)
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.machines)
    rows = []
    for place in arguments.places:
        rows.append(score_of(place, arguments.sensors, arguments.rings, seeds))
    print(markdown_table(rows))


if __name__ == "__main__":
    main()
