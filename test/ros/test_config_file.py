"""config/calibrator.yaml and launch/calibrator.launch.py agree with the code.

``python test/ros/test_config_file.py > config/calibrator.yaml`` writes the file anew after an
option has changed.
"""

import dataclasses
import textwrap

import yaml
from source_code import ROOT

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.core.base.option import option_name

HEADER = """\
# All parameters of the node calibrator, with their defaults.
# Keep the decimal point of a number: for ROS, 2 and 2.0 have different types.
# A parameter in a comment is not set: a check may choose its value. A check never changes a value
# that is set, even if it is the default.
"""
CONVENTIONS = [
    f"{stream}_{kind}"
    for stream in ("parent", "child")
    for kind in ("invert", "quaternion")
]
ONLY_SHOWN = ("time_offset", "scale", "parent_scale", *CONVENTIONS)


def fields():
    return [
        field
        for config in (CalibratorConfig, NodeConfig)
        for field in dataclasses.fields(config)
    ]


def expected_file():
    """The file that the option dataclasses define."""
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
        mark = "# " if key in ONLY_SHOWN else ""
        lines.append(f"{indent}{mark}{key}: {value_of(field)}")
    return "\n".join(lines) + "\n"


def comment_of(field):
    meta = field.metadata
    parts = [meta["doc"]]
    if meta["choices"]:
        parts.append(f"One of {', '.join(meta['choices'])}.")
    if meta["within"]:
        parts.append(
            f"{' to '.join(map(number, meta['within']))} {meta['unit']}".rstrip()
            + "."
        )
    if meta["read_only"]:
        parts.append("Fixed once the node runs.")
    return " ".join(parts)


def number(value):
    return str(value) if isinstance(value, int) else f"{value:g}"


def value_of(field):
    if isinstance(field.default, bool):
        return str(field.default).lower()
    return (
        f'"{field.default}"'
        if isinstance(field.default, str)
        else repr(field.default)
    )


def test_the_config_file_follows_the_options_and_has_their_types():
    text = (ROOT / "config" / "calibrator.yaml").read_text(encoding="utf-8")
    assert text == expected_file()
    written = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert (written["threshold"], written["min_pairs"]) == (0.01, 10)


if __name__ == "__main__":
    print(expected_file(), end="")
