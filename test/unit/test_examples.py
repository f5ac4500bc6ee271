"""Examples run, and what they say holds."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from hand_eye_calib.cli.main import main

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


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
    outputs = [cell.outputs for cell in stored.cells if cell.cell_type == "code"]
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
    main(["simulate", "--out", str(tmp_path / "drives"), "--poses", "200", "--seed", "2"])
    run = tmp_path / "drives" / "run_01"
    files = (run / "T_S1_W1.txt", run / "T_S2_W2.txt", tmp_path / "result")
    result = imported("calibrate_files").main(*map(str, files))
    assert (tmp_path / "result" / "extrinsic.yaml").exists()
    truth = np.loadtxt(run / "T_S2_S1.txt")[1:4]
    np.testing.assert_allclose(result.T_parent_child[:3, 3], truth, atol=4e-3)
    assert result.headline in capsys.readouterr().out


def test_arrays_are_calibrated(capsys):
    example = imported("from_arrays")
    np.testing.assert_allclose(
        example.main().T_parent_child, example.T_LIDAR_CAMERA, rtol=0, atol=1e-6
    )
