"""The Examples section of every public name does what it says."""

import doctest
import importlib.util
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from source_code import ROOT

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.offline.cli.main import main

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
T_CAMERA_REAR = se3.exp(np.array([-0.5, 0.1, 0.2, 0.1, 0.2, 0.3]))


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the examples use: a simulated drive of three sensors, its files, a result."""
    folder = tmp_path_factory.mktemp("examples")
    drive = hec.simulate(1, outliers=0.0)
    parent = drive.parent
    child = drive.child
    noise = np.random.default_rng(1).normal(0.0, 1e-3, (len(child), 6))
    other = hec.Trajectory(
        child.stamps_ns, child.poses @ T_CAMERA_REAR @ se3.exp(noise), "rear"
    )
    hec.write_trajectory(folder / "lidar.tum", parent)
    hec.write_trajectory(folder / "camera.tum", child)
    hand = parent.at(child.stamps_ns[10:810:20])
    camera = child[10:810:20]
    pairs = zip(hand.tolist(), se3.inverse(camera.poses).tolist(), strict=True)
    (folder / "samples.yaml").write_text(
        json.dumps(list(pairs)), encoding="utf-8"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield {
            "hec": hec, "np": np, "parent": parent, "child": child, "other": other,
            "result": hec.calibrate("lidar.tum", "camera.tum"),
        }  # fmt: skip


@pytest.mark.parametrize("name", hec.__all__)
def test_the_examples_of(name, names, no_figures):
    examples = doctest.DocTestParser().get_doctest(
        getattr(hec, name).__doc__, dict(names), name, None, 0
    )
    assert examples.examples, f"{name} has no Examples section"
    failures = []
    doctest.DocTestRunner(optionflags=FLAGS).run(examples, out=failures.append)
    assert not failures, "".join(failures)


def test_the_help_of_calibrate_has_every_option_with_its_default():
    text = hec.calibrate.__doc__
    assert "Default: 0.01 m^2." in text
    assert "'none' or 'poses' or 'orientations', optional" in text
    assert "OPTIONS" not in text


def test_the_roles_may_be_exchanged(names):
    result = names["result"]
    back = hec.calibrate("camera.tum", "lidar.tum")
    apart = se3.log(
        se3.inverse(result.inverse().T_parent_child) @ back.T_parent_child
    )
    assert (np.abs(apart) < 0.5 * np.sqrt(np.diag(back.covariance))).all()
    assert_allclose(result.inverse().sigmas, back.sigmas, rtol=0.6)
    assert_allclose(result.inverse().inverse().sigmas, result.sigmas, rtol=1e-6)
    assert (result == "another", result == result.inverse()) == (False, False)


EXAMPLES = ROOT / "examples"


def imported(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_notebook_runs_and_keeps_its_outputs(tmp_path):
    nbformat = pytest.importorskip("nbformat")
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    stored = nbformat.read(EXAMPLES / "kitti_like.ipynb", as_version=4)
    outputs = [
        cell.outputs for cell in stored.cells if cell.cell_type == "code"
    ]
    assert all(outputs), "make notebook runs it and keeps its outputs"
    values = "[error_cm, error_deg, table['inliers'].tolist(), on_flat_ground.unobservable()]"
    program = f"import json; print(json.dumps({values}))"
    stored.cells.append(nbformat.v4.new_code_cell(program))
    nbformat.write(stored, tmp_path / "notebook.ipynb")
    run = imported("run_notebooks").executed(tmp_path / "notebook.ipynb")
    (printed,) = run.cells[-1].outputs
    error_cm, error_deg, inliers, unobservable = json.loads(printed["text"])
    assert error_cm < 10
    assert error_deg < 0.1
    assert max(inliers) == 1199
    assert unobservable == ["z"]


def test_files_are_calibrated_and_saved(tmp_path, capsys):
    main(
        [
            "simulate",
            "--out",
            str(tmp_path / "drives"),
            "--poses",
            "200",
            "--seed",
            "2",
        ]
    )
    run = tmp_path / "drives" / "run_01"
    files = (run / "T_S1_W1.txt", run / "T_S2_W2.txt", tmp_path / "result")
    result = imported("calibrate_files").main(*map(str, files))
    assert (tmp_path / "result" / "extrinsic.yaml").exists()
    truth = np.loadtxt(run / "T_S2_S1.txt")[1:4]
    assert_allclose(result.T_parent_child[:3, 3], truth, atol=4e-3)
    assert result.headline in capsys.readouterr().out


def test_arrays_are_calibrated(capsys):
    example = imported("from_arrays")
    assert example.main().T_parent_child == pytest.approx(
        example.T_LIDAR_CAMERA, abs=1e-6
    )
