"""Structured text, YAML and journals: the grammar is right, what it says may be anything."""

import json

import numpy as np
import yaml
from motions import as_trajectory, child_of, disturbed, wandering_poses
from result_making import calibration

from hand_eye_calib.config import CalibratorConfig
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


# ---- YAML

ODD_SCALARS = (
    *("2024-13-45", "9" * 5000, "!!float abc", "!!int ''", "~", ".nan", "-.inf", "0o17", "1:60:60"),
    *("0x" + "f" * 100, "!!binary aGk=", "!!set {a}", "!!python/name:os.system", "*nowhere", "&a"),
    *("'", '"\\x00"', '"\\e[2J"', "? ", "|", ">-", "@", "%", "yes", "1e5", "- - -", "<<", "[1, 2"),
    *("!!timestamp x", "!!omap [a: 1]", "[" * 200, "{" * 200, "{a: 1, a: 2}", "]", "\t", "!!str"),
    *("!<x>", "...", "---", "😀", "\x07"),
)


def scalar(chaos):
    """A value that is one line."""
    common = ("1", "0.5", "true", "null", "text", "'quoted'", "auto", "B5", "/a", "lidar")
    return chaos.choice(ODD_SCALARS) if chaos.hits(5) else chaos.choice(common)


def grammar(chaos, keys, depth=0):
    """A random document in flow style, with aliases and merge keys."""
    kind = chaos.random.random()
    if depth > 5 or kind < 0.4:
        return scalar(chaos)
    anchor = f"&n{chaos.random.randrange(99)} " if chaos.random.random() < 0.3 else ""
    count = chaos.random.randrange(5)
    if kind < 0.6:
        return f"{anchor}[{', '.join(grammar(chaos, keys, depth + 1) for _ in range(count))}]"
    pairs = [f"{chaos.choice(keys)}: {grammar(chaos, keys, depth + 1)}" for _ in range(count)]
    if chaos.random.random() < 0.1:
        alias = f"*n{chaos.random.randrange(99)}"
        pairs.append(f"<<: {chaos.choice([alias, f'[{alias}, {alias}]'])}")
    return f"{anchor}{{{', '.join(chaos.items(pairs))}}}"


def bomb(chaos):
    """A document that is small and expands without end."""
    depth, width = chaos.choice([3, 10, 40]), chaos.choice([2, 9, 30])
    merges = chaos.random.random() < 0.5
    lines = ["a0: &a0 {x: 1}" if merges else "a0: &a0 [x, x]"]
    for k in range(1, depth):
        aliases = ", ".join([f"*a{k - 1}"] * width)
        lines.append(f"a{k}: &a{k} {{<<: [{aliases}]}}" if merges else f"a{k}: &a{k} [{aliases}]")
    return "\n".join(lines)


def altered(chaos, document):
    """A document with some values replaced, left out or added."""
    if chaos.hits(0.5):
        return chaos.choice(
            [None, 5, "x", [], {}, [1], {"a": 1}, 1e300, -1, True, [[]], "\x1b", 2**62]
        )
    if isinstance(document, dict):
        items = chaos.items([(key, altered(chaos, value)) for key, value in document.items()])
        return dict(items)
    if isinstance(document, list):
        return chaos.items([altered(chaos, value) for value in document])
    return chaos.real(document) if isinstance(document, float) else document


DOCUMENTS = {
    "config": CalibratorConfig().to_options(),
    "info": calibration().to_dict(),
    "metadata": {
        "rosbag2_bagfile_information": {
            "version": 9,
            "relative_file_paths": ["bag.mcap"],
            "files": [{"path": "bag.mcap"}],
        }
    },
}
KEYS = ("bags", "bag", "name", "options", "method", "reference", "ros__parameters", "calibrator",
        "format", "status", "rosbag2_bagfile_information", "relative_file_paths", "prior.x", "a",
        "'/**'", "max_gap", "parent_topic", "5", "? [a]")  # fmt: skip


def yaml_text(chaos, kind):
    """A YAML file meant as one of DOCUMENTS."""
    drawn = chaos.random.random()
    if drawn < 0.2:
        return chaos.data(grammar(chaos, KEYS).encode("utf-8", "surrogatepass"))
    if drawn < 0.25:
        return bomb(chaos).encode()
    document = altered(chaos, DOCUMENTS[kind])
    flow = chaos.choice([True, False, None])
    return chaos.data(
        yaml.safe_dump(document, default_flow_style=flow, allow_unicode=True).encode()
    )


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
