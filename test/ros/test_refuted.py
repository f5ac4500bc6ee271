"""A prior that the motion contradicts, on every surface of the real node."""

import json

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from motions import disturbed
from ros_harness import (
    RELIABLE_INPUTS,
    START_NS,
    T_PARENT_CHILD,
    matrix,
    values_of,
)
from std_msgs.msg import String

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import Verdict
from hand_eye_calib.formats.results import load_result

WRONG_Z = T_PARENT_CHILD[2, 3] + 1.7


def drive_over_ramps(n_poses=300, flat_s=12.0):
    """Stamps and poses of both sensors: on flat ground at first, which does not show z."""
    stamps_ns = START_NS + 100_000_000 * np.arange(n_poses)
    seconds = (stamps_ns - START_NS) * 1e-9
    after_s = np.maximum(seconds - flat_s, 0.0)
    yaw = 0.8 * np.sin(0.7 * seconds)
    pitch = 0.4 * np.sin(0.9 * after_s)
    roll = 0.5 * np.sin(0.6 * after_s)
    turns = np.stack([roll, pitch, yaw], axis=1)
    height = 0.5 * np.sin(0.5 * after_s)
    places = np.stack([seconds, 2.0 * np.sin(0.5 * seconds), height], axis=1)
    Ts_pw_p = se3.from_rotation_translation(se3.rotation_exp(turns), places)
    # Noise of each sensor: without it, one stream would be computed from the other.
    Ts_cw_c = disturbed(Ts_pw_p @ T_PARENT_CHILD, 1, 1e-3, 7e-4)
    return stamps_ns, disturbed(Ts_pw_p, 2, 1e-3, 7e-4), Ts_cw_c


def assert_both_advise_a_remedy(statuses):
    endings = {
        "extrinsic": "check value, unit and sign of prior.z, or remove it",
        "progress": "Correct the value (number, unit, sign), or remove it.",
    }
    for name in endings:
        status = statuses[f"/calibrator: {name}"]
        assert status.level == status.WARN
        assert status.message.endswith(endings[name])


def test_a_contradicted_prior_withdraws_the_result_until_it_is_removed(
    start_node, peer, tmp_path
):
    directory = tmp_path / "out"
    node = start_node(
        "-p solve_period:=0.2",
        f"-p prior.z:={WRONG_Z:.3f}+/-0.02",
        f"-p output_directory:={directory}",
        *RELIABLE_INPUTS,
    )
    publishers = peer.publishers()
    statuses = peer.diagnostics()
    states = peer.listen(String, "progress")
    stamps_ns, Ts_pw_p, Ts_cw_c = drive_over_ramps()
    _, early = peer.solve(
        publishers, stamps_ns[:100], Ts_pw_p[:100], Ts_cw_c[:100]
    )
    # Of the prior alone.
    assert matrix(early)[2, 3] == pytest.approx(WRONG_Z, abs=0.02)

    peer.feed(publishers, stamps_ns[100:], Ts_pw_p[100:], Ts_cw_c[100:])
    sentence = "the prior on z is"
    peer.spin_until(
        lambda: sentence in statuses["/calibrator: extrinsic"].message,
        "the contradiction",
    )
    advice = "The value typed in for z contradicts the motion"
    peer.spin_until(
        lambda: advice in statuses["/calibrator: progress"].message,
        "the advice",
    )
    answer = peer.trigger("solve")
    assert not answer.success
    assert answer.message.startswith("DO NOT USE: the prior on z")
    assert_both_advise_a_remedy(statuses)
    values = values_of(statuses["/calibrator: extrinsic"])
    assert (values["standing"], values["contradicted"]) == ("refuted", "z")
    result = json.loads(states[-1].data)["extrinsic"]["result"]
    assert result["verdict"] == "DO NOT USE"
    # Who subscribes now gets no number.
    late = peer.listen(TransformStamped, "extrinsic")
    late_with_covariance = peer.listen(
        PoseWithCovarianceStamped, "extrinsic_with_covariance"
    )
    late_states = peer.listen(String, "progress")
    peer.spin_until(lambda: late_states, "what is latched")
    saved = peer.trigger("save")
    assert saved.success
    assert ": DO NOT USE: the prior on z is " in saved.message
    assert load_result(directory).verdict is Verdict.DO_NOT_USE
    kept = peer.trigger("reset").message
    assert kept.startswith("all poses discarded, new session; prior.z ")
    assert kept.endswith(" still set: set to '' to remove it")
    assert (late, late_with_covariance) == ([], [])

    assert peer.set_parameter("prior.z", "").successful
    _, right = peer.solve(publishers, stamps_ns, Ts_pw_p, Ts_cw_c)
    assert matrix(right)[2, 3] == pytest.approx(T_PARENT_CHILD[2, 3], abs=0.02)
    node.wait_for_log("[WARN]", "DO NOT USE: the prior on z is")


def test_a_prior_that_is_removed_gives_the_result_of_the_same_poses_back(
    start_node, peer
):
    start_node(
        "-p solve_period:=0.2",
        f"-p prior.z:={WRONG_Z:.3f}+/-0.02",
        *RELIABLE_INPUTS,
    )
    publishers = peer.publishers()
    statuses = peer.diagnostics()
    extrinsics = peer.listen(TransformStamped, "extrinsic")
    peer.feed(publishers, *drive_over_ramps())

    def standing():
        return values_of(statuses["/calibrator: extrinsic"]).get("standing")

    peer.spin_until(
        lambda: statuses and standing() == "refuted", "the contradiction"
    )
    assert peer.set_parameter("prior.z", "").successful
    peer.spin_until(
        lambda: standing() == "current", "the result without the prior"
    )

    def is_right():
        return (
            extrinsics
            and abs(matrix(extrinsics[-1])[2, 3] - T_PARENT_CHILD[2, 3]) < 0.02
        )

    peer.spin_until(is_right, "the right height")
