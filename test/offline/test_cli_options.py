"""Options of the commands: help, values, configuration files."""

import argparse
import dataclasses
import io
import json
import re
import sys
from pathlib import Path

import pytest
from numpy.testing import assert_allclose
from result_making import good_calibration, written_finding
from source_code import ROOT

import hand_eye_calib as hec
from hand_eye_calib.core.base.config import CalibratorConfig
from hand_eye_calib.core.base.option import option_name
from hand_eye_calib.core.base.registry import COMMANDS
from hand_eye_calib.core.results.records import Finding, Severity
from hand_eye_calib.offline.cli import check
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.offline.cli.options import (
    fail,
    not_typed,
    note,
    typed_options,
    waiting_for,
    with_progress,
)
from hand_eye_calib.offline.cli.present import next_steps

pytestmark = pytest.mark.usefixtures("no_figures")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_fits_a_screen_and_names_options_that_exist(run, command):
    code, brief, _ = run(command, "--help")
    assert code == 0
    assert len(brief.splitlines()) <= 30
    _, whole, _ = run(command, "--help", "all")
    if brief != whole:
        assert f"all options: hand_eye_calib {command} --help all" in brief
    named = set(re.findall(r"--[a-z][a-z-]+", brief)) - {
        "--help",
        "--ros-args",
        "--params-file",
    }
    assert named <= set(re.findall(r"--[a-z][a-z-]+", whole))


def test_help_lists_every_option_with_its_default(run):
    code, out, _ = run("calibrate", "--help", "all")
    assert code == 0
    assert out.startswith(
        "usage: hand_eye_calib calibrate [OPTION ...] PATH ...\n"
    )
    assert (
        out.index("--method")
        < out.index("rarely needed")
        < out.index("--max-gap")
    )
    words = " ".join(out.partition("\nexamples:")[0].split())
    assert " --prior AXIS=VALUE+/-SIGMA " in words
    for field in dataclasses.fields(CalibratorConfig):
        if field.name.startswith("prior_"):
            continue
        name = f"--{option_name(field).replace('.', '-').replace('_', '-')}"
        entry = words[words.rindex(f" {name} ") :].replace("- ", "-")
        entry = entry[: entry.find(" --", 1)]
        assert field.metadata["doc"] in entry, name
        assert (
            f"Unit: {field.metadata['unit']}" in entry
            or not field.metadata["unit"]
        ), name
        assert f"Default: {field.default}." in entry or field.default == "", (
            name
        )


@pytest.mark.parametrize(
    ("options", "changed"),
    [
        (
            ["--keyframe-min-translation", "0.5"],
            {"keyframe_min_translation": 0.5},
        ),
        (["--time-offset", "-1e-3"], {"time_offset": -1e-3}),
        (
            ["--prior", "z=-1.85+/-0.02", "--prior", "yaw=-90deg+/-2deg"],
            {"prior_z": "-1.85+/-0.02", "prior_yaw": "-90deg+/-2deg"},
        ),
        (["--scale", "none"], {}),
        (
            ["--min-pairs", "20", "--reference", "C5"],
            {"min_pairs": 20, "reference": "C5"},
        ),
    ],
)
def test_options_reach_the_engine(options, changed):
    assert parsed(options) == dataclasses.replace(CalibratorConfig(), **changed)


def parsed(options):
    """The configuration that ``calibrate`` makes of its options."""
    import argparse

    from hand_eye_calib.offline.cli.config_file import options_from
    from hand_eye_calib.offline.cli.options import add_config_arguments

    parser = argparse.ArgumentParser()
    add_config_arguments(parser)
    return CalibratorConfig.from_options(
        options_from(parser.parse_args(options))
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly"], "invalid choice: 'fly'"),
        (
            ["calibrate", str(ROOT / "README.md")],
            "is one trajectory file: pass the files of two",
        ),
        (
            ["calibrate", "a.tum", "b.mcap"],
            "b.mcap is a bag, and another path is not",
        ),
        (
            ["check", "a.mcap", "b.mcap"],
            "expected one bag or two trajectory files",
        ),
        (
            ["replay", "bag", "--methd", "dnl"],
            "unknown '--methd'; did you mean --method?",
        ),
        (
            ["replay", "bag", "--threshold", "-1"],
            "--threshold: must be at least 1e-12 m^2; got -1",
        ),
        (
            ["replay", "bag", "--threshold", "big"],
            "--threshold: must be a number in m^2; got 'big'",
        ),
        (
            ["replay", "bag", "--reference", "D4"],
            "--reference: must be auto, A, B<n> such as B5",
        ),
        (["replay", "bag", "--method", "dnlp"], "got 'dnlp'; did you mean dnl"),
        (["info", "a", "b"], "unknown 'b'"),
        (["chek", "bag"], "did you mean check?"),
        (["info"], "the following arguments are required: RESULT"),
        (
            ["replay", "bag", "--vehicle", "a"],
            "--vehicle is an option of batch",
        ),
        (
            ["replay", "bag", "--batch", "fleet"],
            "--batch cannot be combined with PATH or --list",
        ),
        (["replay", "--batch", "none*"], "no bag matches none*"),
        (["watch", "--web", "high"], "expected PORT or HOST:PORT, got 'high'"),
        (
            ["watch", "--web", "99999"],
            "expected PORT or HOST:PORT, got '99999'",
        ),
        (
            ["replay"],
            "usage: hand_eye_calib replay [OPTION ...] PATH ...\n\nexamples:\n",
        ),
    ],
)
def test_wrong_usage(run, arguments, message):
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert message in err


@pytest.fixture
def config_file(tmp_path):
    """Writes text into a file and returns the option that names it."""

    def write(text):
        path = tmp_path / "config.yaml"
        path.write_text(text)
        return ["--config", str(path)]

    return write


@pytest.mark.parametrize(
    "text",
    [
        "{method: dnl, threshold: 1e-3, keyframe.min_interval: 1}",
        "/**: {ros__parameters: {method: dnl, threshold: 0.001, keyframe: {min_interval: 1.0}}}",
        "/**: {ros__parameters: {method: dnlo, threshold: 0.001}}\n"
        "robot: {calibrator: {ros__parameters: {method: dnl, keyframe.min_interval: 1.0}}}\n"
        "/camera_driver: {ros__parameters: {exposure: 3}}",
    ],
)
def test_config_file_plain_or_for_ros(config_file, text):
    expected = CalibratorConfig(
        method="dnl", threshold=1e-3, keyframe_min_interval=1.0
    )
    assert parsed(config_file(text)) == expected
    options = ["--method", "dnlo", "--target-translation", "5cm"]
    other = dataclasses.replace(
        expected, method="dnlo", target_translation=0.05
    )
    assert parsed([*config_file(text), *options]) == other


def test_the_config_file_of_the_package_holds_the_defaults(config_file, capsys):
    assert (
        parsed(["--config", str(ROOT / "config" / "calibrator.yaml")])
        == CalibratorConfig()
    )
    assert parsed(config_file("/**: {ros__parameters: }")) == CalibratorConfig()
    assert "only the node uses 'solve_period'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "{methd: dnl}",
            r"config\.yaml: unknown option 'methd'; did you mean 'method'\?",
        ),
        ("{threshold: -1.0}", r"config\.yaml: 'threshold' must be at least"),
        (
            "[1, 2]",
            r"config\.yaml: expected a mapping of options to values; found list",
        ),
        (
            "/slam: {ros__parameters: {a: 1}}",
            "named calibrator; the file has those of /slam",
        ),
        (
            "/calibrator: {ros__parameters: [1]}",
            "unknown option '/calibrator.ros__parameters'",
        ),
        ("reference: B" + "9" * 3000, "reference"),
        ("max_gap: 2024-13-45", "max_gap"),
        ("5: 6", "unknown option '5'"),
    ],
)
def test_config_files_that_are_wrong_end_with_usage_error(
    refused, config_file, text, message
):
    line = refused("calibrate", "a", "b", *config_file(text), code=2)
    assert re.search(message, line)
    assert len(line) < 1000


def test_the_sample_in_the_package_gives_its_true_extrinsic(capsys):
    assert (
        main(["calibrate", "sample:lidar.tum", "sample:camera.tum", "--json"])
        == 0
    )
    matrix = json.loads(capsys.readouterr().out)["T_parent_child"]["matrix"]
    truth = hec.read_trajectory(
        Path(hec.__file__).parent / "sample" / "truth.tum"
    ).poses[0]
    assert_allclose(matrix, truth, atol=0.005)


@pytest.mark.parametrize("name", ["truth.tum", "T_S2_S1.txt"])
def test_the_truth_of_a_simulation_is_compared_whatever_its_ending(
    tmp_path, capsys, name
):
    sample = Path(hec.__file__).parent / "sample" / "truth.tum"
    (tmp_path / name).write_bytes(sample.read_bytes())
    result = str(tmp_path / "result")
    main(
        ["calibrate", "sample:lidar.tum", "sample:camera.tum", "--out", result]
    )

    assert main(["compare", result, "--with", str(tmp_path / name)]) == 0
    assert "same" in capsys.readouterr().out


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_progress_is_shown_on_a_terminal_and_wiped_out(monkeypatch, capsys):
    assert list(with_progress(range(3), 3, "reading")) == [0, 1, 2]
    assert capsys.readouterr().err == ""
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    assert list(with_progress(range(20), 20, "reading")) == list(range(20))
    shown = terminal.getvalue()
    assert "reading" in shown
    assert "\x1b[2K" in shown.rpartition("reading")[2]  # wiped out
    with waiting_for("solving"):
        assert terminal.getvalue().endswith("solving ...")
    assert terminal.getvalue().endswith("\r\033[K")


def test_messages_name_options_as_they_are_typed(capsys):
    message = "raise max_gap, or give prior.z; see 'max_gap' in /data/max_gap.txt and time_offset=3"
    note(message, "give `scale` or `child_columns`, not `this`")
    fail("keyframe.min_interval: no scale", 1)
    assert capsys.readouterr().err == (
        "hand_eye_calib: note: raise --max-gap, or give --prior z; see 'max_gap' in "
        "/data/max_gap.txt and time_offset=3\n"
        "hand_eye_calib: note: give --scale or --child-columns, not `this`\n"
        "hand_eye_calib: error: --keyframe-min-interval: no scale\n"
    )


def test_options_are_printed_as_they_are_typed():
    options = {
        "prior.z": "VALUE+/-SIGMA",
        "max_gap": 0.2,
        "target.translation": 0.01,
    }
    typed = typed_options(options.items())
    assert (
        typed == "--prior z=0.50+/-0.02 --max-gap 0.2 --target-translation 0.01"
    )


@pytest.mark.parametrize(
    ("typed", "proposed", "missing"),
    [
        ([], ["scale"], ["scale"]),
        (["--scale", "estimate"], ["scale"], []),
        (["--scale=estimate"], ["scale"], []),
        (["--scale", "1.02"], ["scale"], ["scale"]),
        (["--scale", "estimate"], ["scale", "max_gap"], ["max_gap"]),
        (["--max-gap", "0.2", "--out", "estimate"], ["scale"], ["scale"]),
        (["--prior", "z=1.8+/-0.1"], ["prior.z"], []),
        (["--prior", "y=1.8+/-0.1"], ["prior.z"], ["prior.z"]),
    ],
)
def test_an_option_that_is_typed_already_is_not_proposed_again(
    typed, proposed, missing
):
    values = {"scale": "estimate", "max_gap": 0.2, "prior.z": "1.8+/-0.1"}
    options = {name: values[name] for name in proposed}
    assert [*not_typed(typed, options)] == missing


@pytest.mark.parametrize(
    ("typed", "command"),
    [
        ("calibrate bag", "hand_eye_calib calibrate bag --scale estimate"),
        (
            "calibrate bag --scale 1.1",
            "hand_eye_calib calibrate bag --scale estimate",
        ),
        ("calibrate bag --scale estimate", None),
        ("calibrate bag --scale=estimate --end 9", None),
    ],
)
def test_the_next_step_is_never_the_command_that_was_run(typed, command):
    found = Finding(
        code="scale",
        key="scale",
        severity=Severity.ERROR,
        values={"scale": 1.0765, "sigma": 0.011},
        options={"scale": 1.077},
    )
    calibration = good_calibration(findings=(found,))
    arguments = argparse.Namespace(typed=typed.split())
    steps = next_steps(calibration, arguments, None)
    assert steps == ([command] if command else [])


@pytest.mark.parametrize(
    ("typed", "ending"),
    [
        ([], ": calibrate with --scale estimate."),
        (["--scale", "estimate"], ": check these findings first: scale."),
    ],
)
def test_a_check_proposes_no_option_that_is_typed_already(typed, ending):
    found = written_finding(
        "scale", Severity.ERROR, "other", options={"scale": "estimate"}
    )
    assert check._verdict([found], typed).endswith(ending)
