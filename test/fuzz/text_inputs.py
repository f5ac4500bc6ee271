"""Structured text and journals: the grammar is right, what it says may be anything."""

import json

import numpy as np
from motions import as_trajectory, child_of, disturbed, wandering_poses

from hand_eye_calib.geometry import se3

POSES = wandering_poses(60)
PARENT, CHILD = as_trajectory(POSES), as_trajectory(disturbed(child_of(POSES), 1, 1e-3, 1e-3))

ODD_TOKENS = ("", "nan", "inf", "-inf", "1e400", "1e154", "-1e300", "0x10", "1_0", "1e-400", "abc",
              "9" * 400, "1e999999999", "-0", "1,5", '"', "'", "\0", "\x1b[2J", "١", "1e9", "NaN",
              "5e-324", "--", "#", "1" * 5000, "+", ".")  # fmt: skip
ODD_LINES = ("", "#", "# t x y z", ",,,,,,,", '"', "\t", " " * 1000, "a,b,c", "1 2 3", "\ufeff",
             "t,t,t,t", ",".join("x" * 3000), "0 " * 3000, '"1\n2"', "\x0c", "\x85")  # fmt: skip

# ---- trajectories


def trajectory(chaos, format):
    """Text of a trajectory, and of its stamps for format kitti."""
    lines, times = [], []
    values = np.concatenate([POSES[:, :3, 3], se3.to_quat_xyzw(POSES)], axis=1)
    for stamp_ns, matrix, row in zip(
        PARENT.stamps_ns.tolist(), POSES, values.tolist(), strict=True
    ):
        x, y, z, qx, qy, qz, qw = map(repr, row)
        stamp = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
        tokens = {
            "tum": [stamp, x, y, z, qx, qy, qz, qw],
            "kitti": [repr(value) for value in matrix[:3].ravel().tolist()],
            "euroc": [str(stamp_ns), x, y, z, qw, qx, qy, qz, "0", "0"],
            "csv": [stamp, x, y, z, qx, qy, qz, qw],
        }[format]
        separator = chaos.text("," if format in ("euroc", "csv") else " ")
        tokens = [chaos.choice(ODD_TOKENS) if chaos.hits(0.3) else token for token in tokens]
        lines.append(separator.join(chaos.items(tokens)))
        times.append(chaos.choice(ODD_TOKENS) if chaos.hits(0.3) else stamp)
    if format == "csv":
        names = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]
        odd = ("", "t [ns]", "x", "sec", "nsec", *ODD_TOKENS)
        names = [chaos.choice(odd) if chaos.hits() else name for name in names]
        lines.insert(0, chaos.choice([",", ";", "\t"] if chaos.hits() else [","]).join(names))
    lines = [chaos.choice(ODD_LINES) if chaos.hits(0.3) else line for line in chaos.items(lines)]
    ends = "\r\n" if chaos.hits() else "\n"
    data = ends.join(lines).encode("utf-8", "surrogatepass")
    return chaos.data(data), "\n".join(chaos.items(times)).encode()


# ---- journals


def journal(chaos, stream):
    """A stream of a journal: what is known of it, poses, and how many the parent had."""
    about = {
        "format": "hand_eye_calib/journal",
        "version": chaos.number(2, 8),
        "frame": chaos.text(f"{stream}_sensor"),
        "options": {"method": "park", "reference": chaos.text("B3")},
    }
    lines = [f"# {json.dumps(about)}"]
    for k, matrix in enumerate(POSES):
        stamp_ns = chaos.number(int(PARENT.stamps_ns[-1]) + k * 100_000_000, 62)
        values = [*matrix[:3, 3], *se3.to_quat_xyzw(matrix)]
        pose = " ".join(str(chaos.real(value)) for value in values)
        if stream == "child" and k % 5 == 0:
            lines.append(f'# {{"parent_poses": {chaos.number(k, 8)}}}')
        lines.append(f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} {pose}")
    text = "\n".join([*chaos.items(lines), ""])
    return chaos.data(text.encode("utf-8", "surrogatepass"))
