"""The Examples section of every public name does what it says."""

import doctest
import json

import numpy as np
import pytest

import hand_eye_calib as hec
from hand_eye_calib.geometry import se3

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
T_CAMERA_REAR = se3.exp(np.array([-0.5, 0.1, 0.2, 0.1, 0.2, 0.3]))


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the examples use: a simulated drive of three sensors, its files, a result."""
    folder = tmp_path_factory.mktemp("examples")
    drive = hec.simulate(1, outliers=0.0)
    parent, child = drive.parent, drive.child
    noise = np.random.default_rng(1).normal(0.0, 1e-3, (len(child), 6))
    other = hec.Trajectory(child.stamps_ns, child.poses @ T_CAMERA_REAR @ se3.exp(noise), "rear")
    hec.write_trajectory(folder / "lidar.tum", parent)
    hec.write_trajectory(folder / "camera.tum", child)
    hand, camera = parent.at(child.stamps_ns[10:810:20]), child[10:810:20]
    pairs = zip(hand.tolist(), se3.inverse(camera.poses).tolist(), strict=True)
    (folder / "samples.yaml").write_text(json.dumps(list(pairs)), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield {
            "hec": hec, "np": np, "parent": parent, "child": child, "other": other,
            "result": hec.calibrate("lidar.tum", "camera.tum"),
        }  # fmt: skip


@pytest.mark.parametrize("name", hec.__all__)
def test_the_examples_of(name, names, no_figures):
    found = doctest.DocTestParser().get_doctest(
        getattr(hec, name).__doc__, dict(names), name, None, 0
    )
    assert found.examples, f"{name} has no Examples section"
    told = []
    doctest.DocTestRunner(optionflags=FLAGS).run(found, out=told.append)
    assert not told, "".join(told)


def test_the_help_of_calibrate_has_every_option_with_its_default():
    text = hec.calibrate.__doc__
    assert "Default: 0.01 m^2." in text
    assert "'none' or 'poses' or 'orientations', optional" in text
    assert "OPTIONS" not in text


def test_the_roles_may_be_exchanged(names):
    there = names["result"]
    back = hec.calibrate("camera.tum", "lidar.tum")
    apart = se3.log(se3.inverse(there.inverse().T_parent_child) @ back.T_parent_child)
    assert (np.abs(apart) < 0.5 * np.sqrt(np.diag(back.covariance_with_floor))).all()
    np.testing.assert_allclose(there.inverse().sigmas_with_floor, back.sigmas_with_floor, rtol=0.6)
    np.testing.assert_allclose(there.inverse().inverse().sigmas, there.sigmas, rtol=1e-6)
    assert (there == "another", there == there.inverse()) == (False, False)
