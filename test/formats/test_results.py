"""Saved calibrations come back to the last bit, and what cannot be one is refused."""

import dataclasses
import json
import os
import re
import stat
from dataclasses import replace

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal
from result_making import calibration, dofs, good_calibration
from source_code import ROOT

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.plain import json_text, plain
from hand_eye_calib.core.checks import findings as wording
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import (
    Calibration,
    SolveStatus,
    Verdict,
)
from hand_eye_calib.core.results.records import (
    AxisScatter,
    CorrelatedError,
    Noise,
)
from hand_eye_calib.extras.partial.rate_bias import RateBias
from hand_eye_calib.formats.results import load_result, save_result, save_rig
from hand_eye_calib.formats.yaml_files import yaml_text
from hand_eye_calib.offline.cli.main import main
from hand_eye_calib.online.live.progress import AxisProgress, Progress

FILES = ["extrinsic.urdf.xacro", "extrinsic.yaml", "static_transform.launch.py"]


def assert_same(found, expected):
    for field in dataclasses.fields(Calibration):
        assert_array_equal(
            getattr(found, field.name),
            getattr(expected, field.name),
            err_msg=field.name,
        )


def test_a_saved_calibration_loads_bit_by_bit_from_file_and_directory(tmp_path):
    written = calibration()
    path = save_result(written, tmp_path / "new" / "results")
    assert path == tmp_path / "new" / "results" / "extrinsic.yaml"
    for source in (path, path.parent, str(path)):
        assert_same(load_result(source), written)
    document = json.loads(json.dumps(written.to_dict(), allow_nan=False))
    assert_same(Calibration.from_dict(document), written)


def test_numbers_of_numpy_anywhere_are_plain_in_yaml_and_json():
    numbers = (
        np.float32(0.5),
        np.int64(3),
        np.bool_(True),
        np.str_("word"),
        None,
    )
    data = {
        "a": [*numbers, {"b": np.array([1.0, 2.0])}],
        "c": (SolveStatus.OK, Verdict.USE),
    }
    values = [0.5, 3, True, "word", None, {"b": [1.0, 2.0]}]
    expected = {"a": values, "c": [SolveStatus.OK.value, Verdict.USE.value]}
    assert plain(data) == expected
    assert (
        yaml.safe_load(yaml_text(data))
        == json.loads(json_text(data))
        == expected
    )


def test_a_result_with_findings_and_all_records_comes_back(tmp_path):
    gain = {"gain": np.float64(1.02), "sigma": np.float64(0.001)}
    noise = Noise(
        in_words=("words",),
        misfit=1.0,
        lasting=(
            CorrelatedError(
                kind="body", part="rotation", sigma=1e-3, tau_s=20.0
            ),
        ),
    )
    axis = AxisProgress(sigma=np.inf, target=0.02, seconds_left=9.0)
    written = calibration(
        findings=(
            wording.finding("rotation_gain", "child", axis="0, 0, 1", **gain),
        ),
        noise=noise,
        parts={
            "goal": Progress(sentence="go on", axes={"x": axis}),
            "rate_bias": RateBias(
                of="child", rad_per_s=(0.1, 0.2, 0.3), sigma=(0.0, 0.0, 0.0)
            ),
        },
        contradictions={"x": 4.5},
        measured="rotations",
    )
    save_result(written, tmp_path)
    read = load_result(tmp_path)
    assert_same(read, written)
    assert read.findings[0].evidence == gain
    assert read.out_of_reach == written.out_of_reach == ("z",)


def written_and_read(finding, **changes):
    """Return a finding that was read from its document, with changes of the document."""
    document = json.loads(json_text(calibration(findings=(finding,)).to_dict()))
    (row,) = document["findings"]
    for name, value in changes.items():
        if value is None:
            del row[name]
        else:
            row[name] = value
    (read,) = Calibration.from_dict(document).findings
    return read


LATE = {"delay_s": 0.12, "sigma_s": 0.01, "shift_m": 0.2}


@pytest.mark.parametrize(
    "finding",
    [
        wording.finding(
            "gaps",
            "parent",
            gaps=np.int64(3),
            longest_s=np.float64(2.5),
            share=0.1,
        ),
        wording.finding(
            "late", code="late", part="positions", others="orientations", **LATE
        ),
        wording.finding("unexplained", share=0.2),
        wording.finding("inverse", "child", options={"child_invert": "poses"}),
    ],
)
def test_a_finding_in_a_file_has_its_values_and_its_sentences(finding):
    assert written_and_read(finding) == finding
    row = finding.to_dict()
    assert row["what"] == finding.what
    assert row["values"] == finding.values
    assert row["evidence"] == finding.evidence


@pytest.mark.parametrize(
    "changes",
    [
        {"values": None, "key": None},
        {"key": "of_an_extra_that_is_not_installed"},
        {"values": {"gaps": 3}},
        {"values": {"gaps": 3, "longest_s": "long", "share": 0.1}},
    ],
    ids=[
        "of version 0.2",
        "unknown key",
        "missing value",
        "value of another type",
    ],
)
def test_a_finding_without_words_keeps_the_sentences_of_its_file(changes):
    finding = wording.finding(
        "gaps", "parent", gaps=3, longest_s=2.5, share=0.1
    )
    read = written_and_read(finding, **changes)
    for name in (
        "code",
        "stream",
        "severity",
        "what",
        "advice",
        "cause",
        "evidence",
    ):
        assert getattr(read, name) == getattr(finding, name)
    assert written_and_read(read) == read


def test_an_axis_that_is_not_known_has_no_number_in_json_and_yaml(tmp_path):
    written = calibration()
    path = save_result(written, tmp_path)
    saved = yaml.safe_load(path.read_text(encoding="utf-8"))
    for document in (saved, json.loads(json_text(written.to_dict()))):
        transform = document["T_parent_child"]
        x, y, _ = written.T_parent_child[:3, 3]
        assert transform["translation"] == [x, y, None]
        assert [sigma is None for sigma in transform["sigma_translation"]] == [
            False,
            False,
            True,
        ]
        assert transform["matrix"] == written.T_parent_child.tolist()
        inverse = document["T_child_parent"]
        assert (
            inverse["translation"] == inverse["sigma_translation"] == [None] * 3
        )
    assert_same(load_result(path), written)


def test_a_rotation_that_is_not_known_has_no_quaternion_and_no_number_for_a_robot(
    tmp_path,
):
    written = calibration(
        T_parent_child=se3.exp(np.array([1.0, 2, 3, 0, 0, 0.3])),
        covariance_measured=np.diag([1e-4] * 5 + [1e4]),
        observability_measured=dofs([0.01] * 5 + [np.inf], ["yaw"]),
    )
    transform = yaml.safe_load(save_result(written, tmp_path).read_text())[
        "T_parent_child"
    ]
    assert transform["quat_xyzw"] is None
    assert transform["rpy_deg"][2] is None
    assert_allclose(transform["rpy_deg"][:2], [0, 0], atol=1e-9)
    assert_same(load_result(tmp_path), written)
    xacro, launch = (
        (tmp_path / name).read_text(encoding="utf-8") for name in ROBOT_FILES
    )
    assert (
        re.search(r'rpy="(.*?)"', xacro)[1].split()[2] == "MEASURE_YAW_BY_HAND"
    )
    assert "'--yaw', 'MEASURE_YAW_BY_HAND'" in launch
    assert "--qx" not in launch


@pytest.mark.parametrize(
    "words", [["info"], ["info", "--json"], ["compare", "--json"]]
)
def test_a_file_with_an_unknown_axis_is_read_by_the_commands(
    tmp_path, capsys, words
):
    for name in ("one", "two"):
        save_result(
            calibration(status=SolveStatus.UNOBSERVABLE), tmp_path / name
        )
    paths = [str(tmp_path / name) for name in ("one", "two")]
    code = main(
        [words[0], *paths[: 1 if words[0] == "info" else 2], *words[1:]]
    )
    output = capsys.readouterr()
    assert (code, output.err) == (0 if words[0] == "info" else 3, "")
    if "--json" not in words:
        assert re.search(r"z +unknown", output.out)
    elif words[0] == "info":
        assert (
            json.loads(output.out)["T_parent_child"]["translation"][2] is None
        )
    else:
        (difference,) = json.loads(output.out)["differences"]
        assert difference["axes"]["z"]["verdict"] == "cannot tell"


def test_the_file_says_where_it_came_from(tmp_path):
    inputs = {"bag": "drive", "messages": 7, "options": {"method": "dnl"}}
    document = yaml.safe_load(
        save_result(calibration(), tmp_path, inputs).read_text(encoding="utf-8")
    )
    assert (document["format"], document["version"]) == (
        "hand_eye_calib/extrinsic",
        2,
    )
    assert (
        document["T_parent_child"]["maps"]
        == "coordinates of caméra: links into lidar"
    )
    product = (
        np.array(document["T_parent_child"]["matrix"])
        @ document["T_child_parent"]["matrix"]
    )
    assert_allclose(product, np.eye(4), atol=1e-14)
    provenance = document["provenance"]
    assert provenance["inputs"] == {"bag": "drive", "messages": 7}
    assert provenance["package"] == "hand_eye_calib"
    assert provenance["package_version"]
    assert provenance["parameters"] == {"method": "dnl"}
    assert provenance["versions"]["numpy"] == np.__version__
    assert provenance["versions"].keys() == {"python", "numpy", "scipy"}
    assert provenance["created"].endswith("+00:00")


ROBOT_FILES = ("extrinsic.urdf.xacro", "static_transform.launch.py")


def test_under_do_not_use_there_is_nothing_for_a_robot(tmp_path):
    save_result(good_calibration(), tmp_path)
    assert sorted(os.listdir(tmp_path)) == FILES
    save_result(good_calibration(status=SolveStatus.NOT_CONVERGED), tmp_path)
    assert os.listdir(tmp_path) == ["extrinsic.yaml"]
    text = (tmp_path / "extrinsic.yaml").read_text(encoding="utf-8")
    assert text.startswith("verdict: DO_NOT_USE\nheadline: ")


def test_saving_again_replaces_the_file_and_leaves_nothing_else(tmp_path):
    before = os.umask(0o027)
    try:
        path = save_result(calibration(), tmp_path)
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    path = save_result(calibration(objective=2.0), tmp_path)
    assert load_result(path).objective == 2.0
    assert sorted(os.listdir(tmp_path)) == FILES


@pytest.mark.parametrize("save", [hec.save, Calibration.save])
def test_the_public_save_keeps_an_earlier_result_with_its_report(
    save, tmp_path
):
    earlier = hec.save(good_calibration(), tmp_path).read_bytes()
    report = tmp_path / "report.html"
    report.write_text("report of the first result, by hand_eye_calib")

    save(calibration(objective=2.0), tmp_path)

    assert not report.exists()
    assert (tmp_path / "previous/report.html").is_file()
    assert (tmp_path / "previous/extrinsic.yaml").read_bytes() == earlier
    assert hec.load(tmp_path).objective == 2.0


def test_the_public_save_keeps_a_report_that_was_written_before_it(tmp_path):
    report = tmp_path / "report.html"
    report.write_text("report of this result, by hand_eye_calib")

    hec.save(calibration(), tmp_path)

    assert report.exists()
    assert not (tmp_path / "previous").exists()


def test_a_write_that_fails_keeps_the_old_file(tmp_path, monkeypatch):
    path = save_result(calibration(), tmp_path)
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(
        InputError,
        match=r"cannot write .*extrinsic\.urdf\.xacro: No space left on device",
    ):
        save_result(calibration(objective=2.0), tmp_path)
    assert path.read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == FILES


def edited(**changes):
    return yaml.safe_dump(calibration().to_dict() | changes)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty; restore it, or calibrate again"),
        ("- 1", "not a saved result"),
        (
            edited(version=3),
            "expected format .*, version 1 or 2; found version 3: read it",
        ),
        (edited(format="urdf"), "found format urdf"),
        (edited(T_parent_child={}), "the calibration has no 'matrix'"),
        (
            edited(T_parent_child={"matrix": [[1.0, 0.0]]}),
            "was changed after it was written",
        ),
        (
            edited(status="splendid"),
            "was changed after it was written: 'splendid'",
        ),
        (edited(warnings=None), "was changed after it was written"),
        (
            "a: [1",
            "is not readable YAML: .*; restore the file, or calibrate again",
        ),
    ],
)
def test_what_is_no_calibration_is_refused_with_the_file(
    tmp_path, text, message
):
    path = tmp_path / "extrinsic.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        load_result(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"cannot read .*absent: No such file"):
        load_result(tmp_path / "absent")
    with pytest.raises(
        InputError, match=r"has no extrinsic\.yaml: name the folder"
    ):
        load_result(tmp_path)
    (tmp_path / "extrinsic.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(InputError, match="not a text file; expected YAML"):
        load_result(tmp_path)


@pytest.mark.parametrize(
    "changes",
    [{}, {"warnings": ()}, {"covariance_allowance": 1e-6 * np.eye(6)}],
    ids=str,
)
def test_documents_follow_the_schema(changes, tmp_path):
    document = validated(calibration(**changes), tmp_path)
    assert document["observability"][2]["sigma_measured"] is None


def validated(result, folder):
    """The document of a result, as JSON and as its file; both must follow the schema."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(
        (ROOT / "docs" / "extrinsic.schema.json").read_text(encoding="utf-8")
    )
    path = save_result(result, folder)
    document = json.loads(json_text(result.to_dict()))
    for written in (document, yaml.safe_load(path.read_text())):
        jsonschema.validate(written, schema)
    return document


def test_documents_of_recordings_follow_the_schema(tmp_path):
    drive = hec.simulate(5, poses=600)
    result = hec.calibrate(drive.parent, drive.child)
    document = validated(result, tmp_path)
    sizes = document["detectability"]
    assert sizes["errors"] == result.detectability.errors
    jsonschema = pytest.importorskip("jsonschema")
    unnamed = replace(result.detectability, shifts={"x": 0.01})
    with pytest.raises(jsonschema.ValidationError, match="required property"):
        validated(result.with_part("detectability", unnamed), tmp_path)
    no_axis = replace(
        result.detectability, errors=dict.fromkeys(sizes["errors"], np.inf)
    )
    hidden = validated(result.with_part("detectability", no_axis), tmp_path)
    assert hidden["detectability"]["errors"]["z"] is None


def test_every_sigma_of_a_document_has_the_allowance_and_its_parts_beside_it():
    document = calibration(covariance_allowance=1e-6 * np.eye(6)).to_dict()
    for name in ("translation", "rpy_deg"):
        measured, whole = (
            document["T_parent_child"][f"{kind}_{name}"]
            for kind in ("sigma_measured", "sigma")
        )
        assert all(
            b is None if a is None else b > a
            for a, b in zip(measured, whole, strict=True)
        )
    for row in document["observability"]:
        assert document["sigma"][row["name"]] == row["sigma"]
        if row["sigma"] is not None:
            parts = np.hypot(row["sigma_measured"], row["allowance"])
            assert row["sigma"] == pytest.approx(parts, rel=1e-12)
    parts = (
        document[f"covariance_{name}"]["matrix"]
        for name in ("measured", "allowance")
    )
    finite = np.array(document["covariance"]["matrix"][0], dtype=float)
    assert_allclose(
        finite, np.sum([columns[0] for columns in parts], axis=0), rtol=1e-12
    )


def of_version_1(document):
    """A document as version 1 had it: sigma and covariance without the allowance."""
    old = {
        **document,
        "version": 1,
        "covariance": document["covariance_measured"],
    }
    old["floor"] = document["covariance_allowance"]
    old["sigma_total"] = document["sigma"]
    old["observability"] = [
        {
            "name": row["name"],
            "verdict": row["verdict"],
            "sigma": row["sigma_measured"],
            "sigma_total": row["sigma"],
            "frame": row["frame"],
        }
        for row in document["observability"]
    ]
    for name in ("covariance_measured", "covariance_allowance", "sigma"):
        del old[name]
    return old


def test_a_document_of_version_1_is_read_with_its_covariance_as_the_measured_part():
    scatter = AxisScatter(sigma=0.003, of_methods=0.004, of_halves=None)
    written = calibration(covariance_allowance=1e-6 * np.eye(6))
    old = of_version_1(written.to_dict()) | {
        "cross_check": {"x": plain(scatter)}
    }
    read = Calibration.from_dict(old)
    assert_array_equal(read.covariance_measured, written.covariance_measured)
    assert_array_equal(read.covariance, written.covariance)
    assert_array_equal(read.sigmas, written.sigmas)
    assert_array_equal(read.allowance, written.allowance)
    assert read.cross_check["x"].sigma == pytest.approx(np.hypot(0.003, 0.001))


def test_a_document_whose_sigma_is_not_that_of_its_parts_is_refused():
    document = calibration().to_dict()
    first, *others = document["observability"]
    changed = document | {"observability": [first | {"sigma": 0.5}, *others]}
    with pytest.raises(
        InputError,
        match="sigma is not the root sum of squares",
    ):
        Calibration.from_dict(changed)


def test_a_document_whose_covariance_is_not_the_sum_of_its_parts_is_refused():
    document = calibration().to_dict()
    changed = document | {"covariance": {"matrix": (1e-4 * np.eye(6)).tolist()}}
    with pytest.raises(
        InputError, match="covariance is not the sum of covariance_measured"
    ):
        Calibration.from_dict(changed)


def test_a_result_without_a_part_has_its_attributes_empty_and_no_others():
    result = calibration()
    without = (
        result.goal,
        result.together,
        result.rate_bias,
        result.T_world_world,
    )
    assert without == (None,) * 4
    assert (result.parent_world_frame, result.child_world_frame) == ("", "")
    with pytest.raises(AttributeError, match="no attribute 'T_child_paren'"):
        _ = result.T_child_paren


def test_a_result_saved_into_the_folder_of_a_rig_keeps_the_launch_file_of_the_rig(
    tmp_path,
):
    save_rig({"format": "rig"}, [calibration()], tmp_path)
    launch = tmp_path / "static_transform.launch.py"
    of_rig = launch.read_text()
    hec.save(dataclasses.replace(calibration(), child_frame="other"), tmp_path)
    assert launch.read_text() != of_rig
    assert (tmp_path / "previous" / launch.name).read_text() == of_rig


def test_a_second_rig_keeps_the_files_of_each_sensor(tmp_path):
    save_rig({"format": "rig"}, [calibration()], tmp_path)
    [path] = tmp_path.glob("*/extrinsic.yaml")
    before = path.read_text()
    second = dataclasses.replace(calibration(), warnings=("of the second rig",))
    save_rig({"format": "rig"}, [second], tmp_path)
    assert path.read_text() != before
    assert (path.parent / "previous" / path.name).read_text() == before
