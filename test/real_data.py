"""Real recordings with known answers, read for tests. They are not part of this package.

They are looked for where :mod:`published_data` looks; a test that needs them is skipped, and says
so, where they are absent.
"""

import json
import random
from dataclasses import dataclass

import numpy as np
import pytest
from published_data import data_folder

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory
from reproduction.recordings import BOREAS, EUROC, SIMPLE_KITTI, rigs_of

# Differences that are really there and that the data's documentation does not give: found by this
# package, and taken out where streams without any fault are wanted. The devices' scales close round
# the cycle to 0.5 %, the drive's is the published 2.2 %.
_TANGO_SCALES = (0.971, 1.024, 1.010)
_ZXL19_OFFSETS_S = {"LO": (-0.052, -0.044, -0.075), "VO": (0.031, 0.034, 0.025)}
_KITTI_LONG_SCALE = 0.9774
_ARM_OFFSETS_S = {"complete": -0.0195, "sim": 0.0}


@dataclass(frozen=True)
class Recording:
    """Two streams of one rig with what is known about them.

    Attributes
    ----------
    name : str
    parent, child : Trajectory
        Sorted, repeated stamps dropped; nothing else is touched.
    time_offset_s : float
        Known: added to the child's stamps it gives the parent's clock.
    scale : float
        Known: factor from the child's lengths to the parent's.
    """

    name: str
    parent: Trajectory
    child: Trajectory
    time_offset_s: float = 0.0
    scale: float = 1.0

    def corrected(self):
        """The child with the known offset and scale taken out."""
        on_parent_clock = self.child.shifted(self.time_offset_s)
        return on_parent_clock.scaled(self.scale)


def tango_pairs():
    """Three handheld devices on one rig, clocks not shared: (parent, child) in a cycle."""
    offsets = {
        "tango_caligula_mars": -126.834,
        "tango_mars_nero": -107.736,
        "tango_nero_caligula": 234.570,
    }
    return [
        _of_rig("asl_tango_easy", name, name, offset, scale)
        for (name, offset), scale in zip(
            offsets.items(), _TANGO_SCALES, strict=True
        )
    ]


def primesense():
    """Motion capture against a camera that sees a target, with gross jumps."""
    return _of_rig("asl_primesense", "primesense", "primesense", 0.02)


def robot_arm(which):
    """An arm's hand against a camera: "complete" is real, with gross jumps; "sim" turns about
    nearly one axis.
    """
    rigs = {"complete": "robot_arm", "sim": "robot_arm about one axis"}
    offset_s = _ARM_OFFSETS_S[which]
    return _of_rig("asl_robot_arm", rigs[which], f"arm {which}", offset_s)


def stops(seed):
    """Poses (32, 4, 4) of the hand and of the camera of the real arm, in no order: those that
    rsasaki0109/Calibrex fits to for this seed (docs/benchmarks/ethz_hand_eye_opencv.md).
    """
    arm = robot_arm("complete")
    hand_ns = arm.parent.stamps_ns
    # Nearest camera pose of each hand pose, with the time between both.
    nearest = {}
    for eye, stamp_ns in enumerate(arm.child.stamps_ns):
        hand = int(np.argmin(np.abs(hand_ns - stamp_ns)))
        apart_ns = abs(int(hand_ns[hand] - stamp_ns))
        if apart_ns <= 11_000_000:
            candidate = (apart_ns, eye)
            nearest[hand] = min(nearest.get(hand, candidate), candidate)
    pairs = []
    for hand in sorted(nearest):
        _, eye = nearest[hand]
        pairs.append((hand, eye))

    order = list(range(len(pairs)))
    random.Random(seed).shuffle(order)
    chosen = [pairs[index] for index in sorted(order[16:48])]
    hands = [hand for hand, _ in chosen]
    eyes = [eye for _, eye in chosen]
    return arm.parent.poses[hands], arm.child.poses[eyes]


def eye_to_hand():
    """Poses (50, 4, 4) of an arm's base in its hand and of a target on the hand in a fixed camera's
    view, both inverse: MoveIt's samples.
    """
    path = (
        data_folder() / "independent" / "moveit_samples" / "pose_samples.json"
    )
    if not path.exists():
        pytest.skip(f"{path} is absent")
    samples = json.loads(path.read_text(encoding="utf-8"))
    rows = np.array(samples, dtype=float)
    hand = rows[:, 0].reshape(-1, 4, 4)
    camera = rows[:, 1].reshape(-1, 4, 4)
    return se3.inverse(hand), se3.inverse(camera)


def thinned(stream, interval_s):
    """Poses at least about so far apart."""
    interval_ns = (interval_s - 0.02) * 1e9
    keep = [0]
    for index, stamp_ns in enumerate(stream.stamps_ns):
        previous_ns = stream.stamps_ns[keep[-1]]
        if stamp_ns - previous_ns >= interval_ns:
            keep.append(index)
    return stream[np.array(keep)]


def zxl19(bag, child):
    """INS against lidar odometry ("LO") or a monocular camera of unknown scale ("VO") on a road
    vehicle, bags 1 to 3.
    """
    rigs = {"LO": "zxl19_lidar", "VO": "zxl19_camera"}
    scale = 1.0
    if child == "VO":
        scales = {1: 3.34, 2: 3.76, 3: 2.66}
        scale = scales[bag]
    offset = _ZXL19_OFFSETS_S[child][bag - 1]
    name = f"zxl19 {bag} {child}"
    return _of_rig("zxl19", rigs[child], name, offset, scale, f"bag{bag}")


def boreas():
    """Lidar (stamps in microseconds) and radar (nanoseconds) of a car, both from one INS."""
    return _of_rig("boreas", "boreas", "boreas")


BOREAS_TRUTH = BOREAS.T_parent_child
EUROC_TRUTH = EUROC.T_parent_child
SIMPLE_KITTI_TRUTH = SIMPLE_KITTI.T_parent_child


def euroc(estimate, flight):
    """Visual-inertial odometry of a flight ("vio_stereo", "v2_01"), and the truth of camera 0."""
    folder = data_folder() / "euroc_vio"
    odometry = read_trajectory(folder / f"{estimate}_{flight}.tum")
    truth = read_trajectory(folder / f"cam0_truth_{flight}.tum")
    return Recording(f"euroc {estimate} {flight}", odometry, truth)


def simple_kitti(drive):
    """Lidar odometry of a road vehicle, camera axes, and the truth with an extrinsic of its own."""
    folder = data_folder() / "simple_kitti"
    odometry = read_trajectory(folder / f"odometry_{drive}.tum")
    truth = read_trajectory(folder / f"truth_{drive}.tum")
    return Recording(f"simple_kitti {drive}", odometry, truth)


def kitti(which):
    """The KITTI drives of Välimäki et al. 2023 as their SLAM recorded them, stamps not shared:
    "short" or "long".
    """
    scale = _KITTI_LONG_SCALE if which == "long" else 1.0
    return _of_rig(
        "valimaki2023", f"kitti_{which}", f"kitti {which}", 0.0, scale
    )


def all_recordings():
    """Every real set the stream checks are measured on."""
    return [
        *tango_pairs(),
        *(zxl19(bag, child) for child in ("LO", "VO") for bag in (1, 2, 3)),
        boreas(),
        robot_arm("complete"),
        robot_arm("sim"),
        primesense(),
        kitti("short"),
        kitti("long"),
    ]


def _of_rig(folder, rig, name, offset_s=0.0, scale=1.0, which="whole"):
    """A recording of :mod:`reproduction.recordings` with what is known about it."""
    rigs = rigs_of(data_folder(), folder)
    (rig_of_name,) = (candidate for candidate in rigs if candidate.name == rig)
    recording = rig_of_name.recordings[which]
    return Recording(name, recording.parent, recording.child, offset_s, scale)
