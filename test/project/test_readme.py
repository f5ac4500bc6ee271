"""README and docs say what the program does: their commands, tables and links are tested."""

import argparse
import dataclasses
import re
import shlex

import pytest
from numpy.testing import assert_allclose
from source_code import ROOT

from hand_eye_calib.core.base.config import CalibratorConfig, NodeConfig
from hand_eye_calib.core.base.option import option_name
from hand_eye_calib.core.base.registry import COMMANDS
from hand_eye_calib.formats import files
from hand_eye_calib.offline.cli.main import main

NODE_PAGE = ROOT / "docs" / "node.md"
LIMITS_PAGE = ROOT / "docs" / "limits.md"
PAGES = {
    page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8")
    for page in (
        *sorted(ROOT.glob("*.md")),
        *sorted((ROOT / "docs").rglob("*.md")),
    )
}
HEADER = ("Name", "Default", "Unit", "Allowed", "Meaning")
FEWEST_WORDS = 700
MOST_WORDS = 900
LIMITS = ROOT / "hand_eye_calib" / "formats/files.py"
HINT = "PYTHONPATH=. python test/project/test_readme.py writes it"


def parameter_table(config):
    """The Markdown table of an option dataclass; parameters that differ by a word share a row."""
    rows = {}
    for field in dataclasses.fields(config):
        meta = field.metadata
        name = option_name(field)
        word = re.match(r"prior\.(.*)|(parent|child)_|", name)
        word = word[1] or word[2] or "nothing"
        cells = [
            f"`{default(field)}`",
            meta["unit"],
            allowed(field),
            meaning(meta),
        ]
        alike = tuple(
            re.sub(rf"(?<![a-z]){word}(?![a-z])", "#", cell) for cell in cells
        )
        rows.setdefault(alike, []).append((name, word))
    table = [
        [", ".join(f"`{name}`" for name, _ in some)]
        + [
            cell.replace("#", "/".join(word for _, word in some))
            for cell in alike
        ]
        for alike, some in rows.items()
    ]
    lines = [
        HEADER,
        ["---"] * len(HEADER),
        *([escaped(cell) for cell in row] for row in table),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def default(field):
    return (
        str(field.default).lower()
        if isinstance(field.default, bool)
        else repr(field.default).replace("'", '"')
    )


def escaped(cell):
    """Escape what Markdown would take for a column or a tag."""
    return cell.replace("|", "\\|").replace("<", "&lt;")


def allowed(field):
    meta = field.metadata
    if isinstance(field.default, bool):
        return "`true`, `false`"
    if meta["choices"]:
        return ", ".join(f"`{choice}`" for choice in meta["choices"])
    words = [f"`{word}`" for word in meta["words"]]
    if meta["within"]:
        low, high = meta["within"]
        return " or ".join([*words, f"{low:g} to {high:g}"])
    if words:
        return " or ".join(words)
    if meta["parse"]:
        return "see meaning"
    return "any path" if field.name.endswith("_directory") else "any name"


def meaning(meta):
    return meta["doc"] + (" Read-only." if meta["read_only"] else "")


@pytest.mark.parametrize("config", [CalibratorConfig, NodeConfig])
def test_parameter_table_is_that_of_the_code(config):
    table = parameter_table(config)
    assert table in PAGES["docs/node.md"], (
        f"docs/node.md must have this table; {HINT}:\n{table}"
    )


def test_parameter_tables_have_no_other_rows():
    rows = re.findall(
        r"^\| (`[a-z_.`, ]+`) \| `[^|]*` \|",
        PAGES["docs/node.md"],
        re.MULTILINE,
    )
    documented = [
        name for row in rows for name in re.findall(r"`([a-z_.]+)`", row)
    ]
    assert documented == [
        option_name(field)
        for config in (CalibratorConfig, NodeConfig)
        for field in dataclasses.fields(config)
    ]


def limits_table():
    """The Markdown table of ``formats/files.py``: its sections, comments and values."""
    lines = ["| Of | What | Limit |", "| --- | --- | ---: |"]
    section = ""
    text = []
    for line in LIMITS.read_text(encoding="utf-8").splitlines():
        if line.startswith("# ---- "):
            section = line.removeprefix("# ---- ")
        elif line.startswith("#:"):
            text.append(line.removeprefix("#:").strip())
        elif match := re.match(r"([A-Z][A-Z_]*) = ", line):
            meaning, in_bytes, more = (
                " ".join(text).rstrip(".").partition(" (bytes)")
            )
            limit = readable(getattr(files, match[1]), bool(in_bytes))
            lines.append(f"| {section} | {meaning}{more} | {limit} |")
            text = []
    return "\n".join(lines)


def readable(value, is_in_bytes):
    """Return a limit as text; many bytes are in MiB."""
    if is_in_bytes and value % (1 << 20) == 0:
        return f"{value >> 20:,} MiB"
    return f"{value:,} bytes" if is_in_bytes else f"{value:,}"


def test_limits_are_those_of_the_code():
    assert limits_table().count("\n") > 6
    assert limits_table() in PAGES["docs/limits.md"], (
        f"docs/limits.md must have this table; {HINT}"
    )


def test_readme_is_short_names_its_two_commands_and_shows_the_report():
    readme = PAGES["README.md"]
    assert FEWEST_WORDS <= len(readme.split()) <= MOST_WORDS
    assert "`make demo`" in readme
    assert "`make test`" in readme
    assert (ROOT / "docs" / "images" / "report.png").stat().st_size < 200_000
    assert "](docs/images/report.png)" in readme


def shell_lines(text):
    """Lines of the shell blocks, and commands in running text that have no placeholder."""
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    yield from "\n".join(blocks).replace("\\\n", " ").splitlines()
    for command in re.findall(r"`((?:ros2 run )?hand_eye_calib [^`]*)`", text):
        if not re.search(r"[A-Z]{3}|\.\.\.| --version", command):
            yield command


def commands(text):
    """Every command of ours on a page, as (subcommand, arguments)."""
    for line in shell_lines(text):
        words = shlex.split(line.partition(" > ")[0], comments=True)
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


@pytest.mark.parametrize(
    "words",
    sorted({command for text in PAGES.values() for command in commands(text)}),
    ids=" ".join,
)
def test_command_parses(words):
    name, *arguments = words
    assert name in COMMANDS
    parser = argparse.ArgumentParser(allow_abbrev=False, exit_on_error=False)
    COMMANDS[name].load().add_arguments(parser)
    if name == "calibrator":
        assert arguments[:1] in ([], ["--ros-args"])
    elif arguments:
        parser.parse_args(arguments)


def test_every_command_has_its_line():
    table = re.findall(r"^\| `([a-z]+)[` ]", PAGES["docs/cli.md"], re.MULTILINE)
    assert sorted(table) == sorted(COMMANDS)


@pytest.mark.parametrize("page", PAGES)
def test_launch_arguments_make_targets_and_files_exist(page):
    """Pages name files of the package from its root, such as ``core/solvers/ipopt.py``."""
    launch_file = (ROOT / "launch" / "calibrator.launch.py").read_text(
        encoding="utf-8"
    )
    lines = [
        line
        for line in PAGES[page].splitlines()
        if line.startswith("ros2 launch")
    ]
    names = {name for line in lines for name in re.findall(r"(\w+):=", line)}
    parameters = {*CalibratorConfig().to_options(), *NodeConfig().to_options()}
    assert {
        name for name in names - parameters if f'"{name}"' not in launch_file
    } == set()
    code = "\n".join(
        re.findall(r"`[^`\n]+`|```bash\n.*?```", PAGES[page], re.DOTALL)
    )
    mentioned = set(re.findall(r"(?:^|`)make ([a-z-]+)", code, re.MULTILINE))
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert mentioned <= set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))
    names = re.findall(r"`([a-z_]+(?:/[a-z_]+)+\.py)(?::\d+)?`", PAGES[page])
    folders = (ROOT, ROOT / "hand_eye_calib")
    assert [
        name
        for name in names
        if not any((top / name).exists() for top in folders)
    ] == []


def test_first_command_of_the_readme_prints_its_output(
    capsys, tmp_path, monkeypatch, no_figures
):
    monkeypatch.chdir(tmp_path)
    (command,) = [
        words
        for words in commands(PAGES["README.md"])
        if words[1:2] == ("sample:lidar.tum",)
    ]
    (output,) = re.findall(r"```text\n(.*?)```", PAGES["README.md"], re.DOTALL)
    assert main(list(command)) == 0
    printed = capsys.readouterr().out
    # The measured parts, less than a tenth of the allowance, change with each noise model.
    measured = re.compile(r"\([\d.]+ (?=\w+ measured)")
    assert measured.sub("(", printed).startswith(measured.sub("(", output))


def test_commands_of_the_readme_on_samples_run(
    tmp_path, monkeypatch, no_figures
):
    monkeypatch.chdir(tmp_path)
    runnable = [
        words
        for words in commands(PAGES["README.md"])
        if "sample:" in " ".join(words)
    ]
    assert [words[1] for words in runnable[1:]] == [
        "result",
        "sample:drive.mcap",
        "sample:arm.yaml",
    ]
    assert [main(list(words)) for words in runnable] == [0, 0, 0, 0]
    assert (tmp_path / "result" / "extrinsic.yaml").exists()


def test_python_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = re.findall(r"```python\n(.*?)```", PAGES["README.md"], re.DOTALL)
    names = {}
    exec(compile(block, "README.md", "exec"), names)
    result = names["result"]
    assert result.T_parent_child.shape == (4, 4)
    assert result.covariance.shape == (6, 6)
    truth = names["hec"].read_trajectory("sample:truth.tum").poses[0]
    assert_allclose(result.T_parent_child, truth, atol=5e-3)
    assert (tmp_path / "python_result" / "extrinsic.yaml").exists()


def anchors(text):
    """Names that links to headings of a page have on GitHub."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        for heading in headings
    }


def links():
    for page, text in PAGES.items():
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if not re.match(r"[a-z]+:", target):
                yield page, target


@pytest.mark.parametrize(("page", "target"), sorted(set(links())))
def test_relative_link_leads_somewhere(page, target):
    path, _, anchor = target.partition("#")
    file = (ROOT / page).parent / path if path else ROOT / page
    assert file.exists()
    if anchor:
        assert anchor in anchors(file.read_text(encoding="utf-8"))


def test_every_package_has_its_line():
    packages = (
        PAGES["docs/architecture.md"]
        .partition("## Packages")[2]
        .partition("\n## ")[0]
    )
    first = " ".join(re.findall(r"^\| (`[^|]*) \|", packages, re.MULTILINE))
    table = re.findall(r"`([a-z_/]+/|[a-z_]+\.py)`", first)
    source = ROOT / "hand_eye_calib"
    rooms = {
        path.parent.relative_to(source).as_posix()
        for path in source.glob("*/*/__init__.py")
    }
    # A layer has a line if it has files beside its rooms.
    layers = {path.parent.name for path in source.glob("*/[a-z]*.py")}
    folders = [f"{folder}/" for folder in rooms | layers]
    assert sorted(table) == sorted(
        [*folders, *(path.name for path in source.glob("*.py"))]
    )


def with_tables_of_the_code(text):
    """The page with both parameter tables as they must be."""
    tables = iter(
        [parameter_table(CalibratorConfig), parameter_table(NodeConfig)]
    )
    old = re.compile(r"^\| Name \| Default \|.*\n(\|.*\n)*", re.MULTILINE)
    return old.sub(lambda _: next(tables) + "\n", text)


if __name__ == "__main__":
    NODE_PAGE.write_text(
        with_tables_of_the_code(PAGES["docs/node.md"]), encoding="utf-8"
    )
    table = re.compile(r"^\| Of \| What \| Limit \|\n(\|.*\n)*", re.MULTILINE)
    page = table.sub(lambda _: limits_table() + "\n", PAGES["docs/limits.md"])
    LIMITS_PAGE.write_text(page, encoding="utf-8")
