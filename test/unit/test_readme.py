"""The README says what the program does: its tables and commands are compared with the code."""

import argparse
import dataclasses
import importlib
import re
import shlex
from pathlib import Path

import pytest

from hand_eye_calib.cli.main import COMMANDS
from hand_eye_calib.config import CalibratorConfig, NodeConfig, option_name

README = Path(__file__).resolve().parents[2] / "README.md"
TEXT = README.read_text(encoding="utf-8")
HEADER = ("Name", "Default", "Unit", "Allowed", "Meaning")


def parameter_table(config):
    """The Markdown table of an option dataclass."""
    rows = [
        [
            f"`{option_name(field)}`",
            f"`{default(field)}`",
            meta["unit"],
            allowed(field),
            meaning(meta),
        ]
        for field in dataclasses.fields(config)
        for meta in [field.metadata]
    ]
    lines = [HEADER, ["---"] * len(HEADER), *([escaped(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def default(field):
    return (
        str(field.default).lower()
        if isinstance(field.default, bool)
        else repr(field.default).replace("'", '"')
    )


def escaped(cell):
    """Without what Markdown would take for a column or a tag."""
    return cell.replace("|", "\\|").replace("<", "&lt;")


def allowed(field):
    meta = field.metadata
    if isinstance(field.default, bool):
        return "`true`, `false`"
    if meta["choices"]:
        return ", ".join(f"`{choice}`" for choice in meta["choices"])
    words = [f"`{word}`" for word in meta["words"]]
    if meta["minimum"] is not None and meta["maximum"] is not None:
        return " or ".join([*words, f"{meta['minimum']:g} to {meta['maximum']:g}"])
    return " or ".join(words) or "any name" if meta["pattern"] is None else "see meaning"


def meaning(meta):
    return meta["doc"] + (" Read-only." if meta["read_only"] else "")


@pytest.mark.parametrize("config", [CalibratorConfig, NodeConfig])
def test_parameter_table_is_that_of_the_code(config):
    table = parameter_table(config)
    hint = "PYTHONPATH=. python test/unit/test_readme.py writes it"
    assert table in TEXT, f"README.md must have this table for {config.__name__}; {hint}:\n{table}"


def test_parameter_tables_have_no_other_rows():
    documented = re.findall(r"^\| `([a-z_.]+)` \| `[^|]*` \|", TEXT, re.MULTILINE)
    assert documented == [
        option_name(field)
        for config in (CalibratorConfig, NodeConfig)
        for field in dataclasses.fields(config)
    ]


def commands():
    """Every command of ours in the README's shell blocks, as (subcommand, arguments)."""
    blocks = re.findall(r"```bash\n(.*?)```", TEXT, re.DOTALL)
    for line in "\n".join(blocks).replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            words = words[1:]
        if words[:3] == ["ros2", "run", "hand_eye_calib"]:
            words = words[3:]
        elif words[:3] == ["python3", "-m", "hand_eye_calib"]:
            words = words[2:]
        if words and words[0] == "hand_eye_calib":
            words = words[1:]
        elif not words or words[0] not in ("calibrator", "replay"):
            continue
        yield tuple(words)


def test_readme_has_commands_to_check():
    assert {words[0] for words in commands()} >= {"replay", "calibrate", "calibrator", "info"}


@pytest.mark.parametrize("words", sorted(set(commands())), ids=" ".join)
def test_command_parses(words):
    name, *arguments = words
    assert name in COMMANDS
    parser = argparse.ArgumentParser(allow_abbrev=False, exit_on_error=False)
    importlib.import_module(f"hand_eye_calib.cli.{name}").add_arguments(parser)
    if name == "calibrator":
        assert arguments[:1] in ([], ["--ros-args"])
    else:
        parser.parse_args(arguments)


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\]\(([^)#:]+)\)", TEXT))))
def test_relative_link_leads_somewhere(target):
    assert (README.parent / target).exists()


def test_make_targets_exist():
    makefile = (README.parent / "Makefile").read_text(encoding="utf-8")
    mentioned = set(
        re.findall(
            r"`?make ([a-z-]+)`?",
            "\n".join(re.findall(r"`[^`]+`|```bash\n.*?```", TEXT, re.DOTALL)),
        )
    )
    targets = set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))
    assert mentioned
    assert mentioned <= targets


def with_tables_of_the_code(text):
    """The README with both parameter tables as they must be."""
    tables = iter([parameter_table(CalibratorConfig), parameter_table(NodeConfig)])
    return re.sub(
        r"^\| Name \| Default \|.*\n(\|.*\n)*",
        lambda _: next(tables) + "\n",
        text,
        flags=re.MULTILINE,
    )


if __name__ == "__main__":
    README.write_text(with_tables_of_the_code(TEXT), encoding="utf-8")
