"""States of the live node, made by hand, and the view of ``watch`` on a state."""

import time
from dataclasses import replace

from hand_eye_calib.online.live.progress import (
    AXIS_KEYS,
    AxisProgress,
    Progress,
)
from hand_eye_calib.online.live.state import (
    Broadcast,
    ChecksState,
    ExtrinsicState,
    InputState,
    JournalState,
    Level,
    MountState,
    NodeState,
    ProgressState,
    ResultState,
    SavedState,
)
from hand_eye_calib.online.watch.board import Board

NODE = "/calibrator"
INF = float("inf")
RESULT = ResultState(
    parent_frame="lidar", child_frame="camera", verdict="USE", status="ok",
    reasons=("a: b", "c: d"), warnings=("repaired",), n_poses=9,
    time_offset_s=0.0, scale=1.0, age_s=1.0,
    pose={"x": 0.42, "y": -0.13, "z": None, "roll": 0.01, "pitch": -0.02, "yaw": 1.5},
    pose_sigma={"x": 0.004, "y": 0.004, "z": None, "roll": 0.01, "pitch": 0.01, "yaw": 0.01},
)  # fmt: skip
EXTRINSIC = ExtrinsicState(
    level=Level.OK, text="known", is_solving=False, n_poses=9, path_m=3.0, rotation_deg={},
    tf_static=Broadcast.OFF, tf_static_reason="", result=RESULT,
)  # fmt: skip
CAREFUL = replace(
    RESULT,
    verdict="USE WITH CARE",
    caution="z might be wrong",
    step="Measure it.",
)
ROTATION = AxisProgress(sigma=0.001, target=0.00524, seconds_left=0.0)
KNOWN = AxisProgress(sigma=0.004, target=0.02, seconds_left=0.0)
BEHIND = AxisProgress(sigma=0.04, target=0.02, seconds_left=25.0)
AT = Progress(
    sentence="Go on for about 25 s: z is behind.",
    limiting_axis="z",
    axes=dict.fromkeys(AXIS_KEYS.values(), ROTATION)
    | {"x": KNOWN, "y": KNOWN, "z": BEHIND},
)
CHECKS = ChecksState(level=Level.OK, text="sound", age_s=3.0, findings=())
MOUNT = MountState(level=Level.OK, text="it has not", seconds_of_motion=200)


FULL = JournalState(level=Level.ERROR, text="cannot write", directory="")
SAVED = SavedState(
    directory="/home/live", at_s=time.time(), text="USE: all six axes"
)


def inputs(parent=Level.OK, child=Level.OK):
    texts = [
        "20.0 Hz",
        "/odom has been silent for 3 s",
        "/odom: bad quaternion",
    ]
    figures = dict.fromkeys(("rate_hz", "longest_gap_s"), 0.0)
    figures |= dict.fromkeys(("messages", "poses_taken", "lost"), 0)
    return {
        name: InputState(
            level=level, text=texts[level], topic="/odom", refused={}, **figures
        )
        for name, level in (("parent", parent), ("child", child))
    }


def state(node=NODE, at=None, axes=None, **parts):
    """The state of a node that goes on, with another progress, or other parts."""
    at = replace(AT, **{"axes": AT.axes | (axes or {}), **(at or {})})
    fields = {"level": Level.OK, "comparison": None, "is_paused": False}
    fields |= {name: parts.pop(name) for name in fields if name in parts}
    progress = ProgressState(text=at.sentence, progress=at, **fields)
    made = {"extrinsic": EXTRINSIC, "progress": progress}
    return NodeState(
        node=node, **{"inputs": inputs(), "checks": CHECKS, **made, **parts}
    )


def mount(**fields):
    return NodeState(node=NODE, mount=replace(MOUNT, **fields), inputs=inputs())


def view_of(document, now_s=0.5):
    board = Board()
    if document is not None:
        board.take(document, 0.0)
    return board.view(now_s)


ERROR = {"level": Level.ERROR}
REACHED = {"done": True, "precision": "good to 4 mm"}
