"""Structured text, YAML and journals: the grammar is right, what it says may be anything."""

import io
import struct
import zipfile
import zlib

import numpy as np
import yaml
from motions import as_trajectory, child_of, wandering_poses
from result_making import calibration

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator
from hand_eye_calib.geometry import se3

POSES = wandering_poses(60)
PARENT, CHILD = as_trajectory(POSES), as_trajectory(child_of(POSES))

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
    "batch": {
        "parent_topic": "/a",
        "options": {"method": "dnl"},
        "bags": ["bag", {"bag": ["x", "y"], "name": "z", "child_tf": "odom:b"}, "*.mcap"],
    },
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


def journal_record(chaos, kind, payload):
    """A record whose checksum is right, whatever is in it."""
    payload = chaos.data(payload)
    kind = bytes([chaos.number(kind[0], 8)])
    checksum = chaos.number(zlib.crc32(payload, zlib.crc32(kind)), 32)
    return struct.pack("<cII", kind, chaos.number(len(payload), 32), checksum) + payload


def checkpoint(chaos):
    """An archive of arrays, of which some are not as they should be."""
    calibrator = Calibrator(CalibratorConfig(reference="B3"))
    for stamp_ns, parent, child in zip(
        PARENT.stamps_ns.tolist(), PARENT.poses, CHILD.poses, strict=True
    ):
        for stream, matrix in (("parent", parent), ("child", child)):
            position, quat_xyzw = matrix[:3, 3].tolist(), se3.to_quat_xyzw(matrix).tolist()
            calibrator.add_pose(stream, stamp_ns, position, quat_xyzw)
    arrays = {}
    for name, array in chaos.items(calibrator.state().items()):
        array = np.asarray(array)
        if chaos.hits(3):
            others = (
                np.array(5),
                np.zeros((3, 0)),
                np.zeros((2, 4, 4)),
                np.array("x"),
                1j * np.ones(9),
            )
            array = chaos.choice([array.astype("U8"), array.ravel()[::-1], array[None], *others])
        if chaos.hits() and array.size and array.dtype.kind in "if":
            array = array.copy()
            array.flat[chaos.random.randrange(array.size)] = chaos.choice([-1, 0, 10**18, 7])
        arrays[chaos.text(name).replace("\0", "0") or "x"] = array
    packed = io.BytesIO()
    np.savez(packed, **{name.replace("/", "_"): array for name, array in arrays.items()})
    if chaos.hits():
        with zipfile.ZipFile(packed, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("bomb.npy", bytes(50 << 20))
    return packed.getvalue()


def journal(chaos):
    """A segment with a checkpoint, poses and names of frames."""
    data = b"hand_eye_calib journal 1\n" + journal_record(chaos, b"C", checkpoint(chaos))
    records = []
    for k, matrix in enumerate(POSES):
        stamp_ns = int(PARENT.stamps_ns[-1]) + k * 100_000_000
        values = [*matrix[:3, 3], *se3.to_quat_xyzw(matrix)]
        for stream in (0, 1):
            head = chaos.number(stream, 8), chaos.number(stamp_ns, 62)
            payload = struct.pack("<Bq7d", *head, *map(chaos.real, values))
            records.append(journal_record(chaos, b"P", payload))
    name = b"\0" + chaos.text("lidar").encode("utf-8", "surrogatepass")
    records.append(journal_record(chaos, b"F", name))
    return chaos.data(data + b"".join(chaos.items(records)))
