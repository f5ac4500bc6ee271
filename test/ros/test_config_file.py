"""config/calibrator.yaml and launch/calibrator.launch.py say what the code says.

``python test/ros/test_config_file.py > config/calibrator.yaml`` writes the file anew after an
option has changed.
"""

import dataclasses
import textwrap
from pathlib import Path

import yaml

from hand_eye_calib.config import CalibratorConfig, NodeConfig, option_name

PROJECT = Path(__file__).resolve().parents[2]
HEADER = """\
# Parameters of the node calibrator: all there are, at their defaults.
# Numbers with a decimal point must keep it: to ROS, 2 and 2.0 are of different types.
# Options in comments are not set here: what is set counts as known, even if it is the default.
"""
CONVENTIONS = [
    f"{each}_{kind}" for each in ("parent", "child") for kind in ("invert", "quaternion")
]
ONLY_SHOWN = ("time_offset", "scale", "parent_scale", *CONVENTIONS)


def fields():
    return [
        field for config in (CalibratorConfig, NodeConfig) for field in dataclasses.fields(config)
    ]


def expected_file():
    """The file as the option dataclasses want it."""
    lines = [HEADER + "/**:", "  ros__parameters:"]
    section = None
    for field in fields():
        *outer, key = option_name(field).split(".")
        if outer and outer[0] != section:
            lines.append(f"    {outer[0]}:")
        section = outer[0] if outer else None
        indent = " " * (6 if outer else 4)
        comment = textwrap.wrap(comment_of(field), width=120 - len(indent) - 2)
        lines += [f"{indent}# {line}" for line in comment]
        lines.append(f"{indent}{'# ' * (key in ONLY_SHOWN)}{key}: {value_of(field)}")
    return "\n".join(lines) + "\n"


def comment_of(field):
    meta = field.metadata
    parts = [meta["doc"]]
    if meta["choices"]:
        parts.append(f"One of {', '.join(meta['choices'])}.")
    if meta["within"]:
        parts.append(f"{' to '.join(map(number, meta['within']))} {meta['unit']}".rstrip() + ".")
    if meta["read_only"]:
        parts.append("Fixed once the node runs.")
    return " ".join(parts)


def number(value):
    return str(value) if isinstance(value, int) else f"{value:g}"


def value_of(field):
    if isinstance(field.default, bool):
        return str(field.default).lower()
    return f'"{field.default}"' if isinstance(field.default, str) else repr(field.default)


def flat(mapping, prefix=""):
    for key, value in mapping.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def test_config_file_has_every_parameter_with_its_default_and_type():
    document = yaml.safe_load((PROJECT / "config" / "calibrator.yaml").read_text(encoding="utf-8"))
    written = dict(flat(document["/**"]["ros__parameters"]))
    wanted = {
        option_name(field): field.default for field in fields() if field.name not in ONLY_SHOWN
    }
    assert written == wanted
    assert {name: type(value) for name, value in written.items()} == {
        name: type(value) for name, value in wanted.items()
    }


def test_config_file_comments_follow_the_options():
    assert (PROJECT / "config" / "calibrator.yaml").read_text(encoding="utf-8") == expected_file()


if __name__ == "__main__":
    print(expected_file(), end="")
