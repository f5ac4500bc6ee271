"""``info --bundle``: all that a report of a wrong answer needs, and nothing else."""

import json
import zipfile

import numpy as np
import pytest
import yaml

import hand_eye_calib as hec
from hand_eye_calib.cli.bundle import MOST_BYTES, tum_text
from hand_eye_calib.cli.main import main
from hand_eye_calib.cli.reading import read_bags
from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.io.results import save_result

pytestmark = pytest.mark.usefixtures("no_figures")

PARENT, CHILD = "secret/run_01/T_S1_W1.txt", "secret/run_01/T_S2_W2.txt"


OPTIONS = ["--method", "dnlo", "--reference", "B5", "--prior", "z=0.5+/-9"]
CONFIG = {"method": "dnlo", "reference": "B5", "prior.z": "0.5+/-9"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording, and results from its files and from its bag."""
    folder = tmp_path_factory.mktemp("bundle")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        main(["simulate", "--out", "secret", "--poses", "200", "--seed", "2", "--bag", "mcap"])
        assert main(["calibrate", PARENT, CHILD, *OPTIONS, "--out", "files"]) == 0
        # As replay --out saves it, without the report.
        config = CalibratorConfig.from_options(CONFIG)
        topics = {"parent": "/parent/odometry", "child": "/child/odometry"}
        recording = read_bags(["secret/run_01/bag"], topics, config)
        save_result(recording.solved(), "bag", recording.inputs)
    return folder


def opened(path):
    with zipfile.ZipFile(path) as bundle:
        return {name: bundle.read(name).decode() for name in bundle.namelist()}


@pytest.mark.parametrize("source", ["files", "bag"])
def test_the_bundle_repeats_the_result(folder, tmp_path, monkeypatch, capsys, source):
    monkeypatch.chdir(folder)
    assert main(["info", source, "--bundle", str(tmp_path / "b.zip")]) == 0
    texts = opened(tmp_path / "b.zip")
    assert sorted(texts) == ["README.txt", "bundle.yaml", "child.tum", "options.yaml", "parent.tum"]
    assert "secret" not in "".join(texts.values())
    about = yaml.safe_load(texts["bundle.yaml"])
    assert about["versions_here"]["numpy"] == np.__version__
    assert about["poses"] == "in parent.tum and child.tum"
    assert yaml.safe_load(texts["options.yaml"])["prior.z"] == "0.5+/-9"

    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    main(["calibrate", "parent.tum", "child.tum", "--config", "options.yaml", "--json"])
    again = hec.Calibration.from_dict(json.loads(capsys.readouterr().out))
    result = hec.load(folder / source)
    np.testing.assert_allclose(again.T_parent_child, result.T_parent_child, atol=5e-3)


def test_without_the_recording_the_rest_is_there(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["info", str(folder / "files"), "--bundle", "b.zip"]) == 0
    assert "the poses are not in the bundle" in capsys.readouterr().err
    texts = opened("b.zip")
    assert sorted(texts) == ["README.txt", "bundle.yaml", "options.yaml"]
    assert "secret" not in "".join(texts.values())


def test_a_bundle_that_cannot_be_written_is_one_line(folder, tmp_path, capsys):
    assert main(["info", str(folder / "files"), "--bundle", str(tmp_path / "no/b.zip")]) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert "cannot write" in line


def test_poses_are_few_and_have_no_place():
    poses = np.repeat(np.eye(4)[None], 50_000, axis=0)
    poses[:, :3, 3] = [555_123.4, 6_655_321.0, 140.0]
    poses[:, 0, 3] += np.arange(50_000)
    text = tum_text(hec.Trajectory(10**18 + 10**8 * np.arange(50_000), poses))
    assert MOST_BYTES / 4 < len(text) <= MOST_BYTES / 2
    assert text.splitlines()[0].split()[1:4] == ["0.000000000"] * 3


def test_the_child_is_moved_to_a_file_or_a_bag(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    result, child = hec.load("files"), hec.read_trajectory(CHILD)
    expected = result.child_as_parent(child)
    for name in ("moved.tum", "moved.bag", "moved"):
        target = str(tmp_path / name)
        assert main(["info", "files", "--move", CHILD, "--to", target]) == 0
        topic = None if name == "moved.tum" else "/odometry"
        moved = hec.read_trajectory(target, topic=topic)
        np.testing.assert_array_equal(moved.stamps_ns, expected.stamps_ns)
        np.testing.assert_allclose(moved.poses, expected.poses, atol=1e-9)
    assert main(["info", "files", "--move", CHILD]) == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert "--move CHILD and --to FILE go together" in line
