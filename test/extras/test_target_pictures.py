"""Pictures of the report: corners of the target through the result."""

import base64
import re

import browser
import numpy as np
import pytest
from target_rendering import (
    CAMERA_INFO,
    MATRIX,
    charuco_picture,
    rendered,
    views,
)

import hand_eye_calib as hec
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.sensors.corners import (
    figures_of_corners,
    reprojections,
)
from hand_eye_calib.extras.sensors.target_images import (
    TargetFinder,
)
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from hand_eye_calib.offline.cli.main import main

cv2 = pytest.importorskip("cv2", reason="needs opencv-python-headless")

TARGET = "charuco:7x5:0.05:0.037:5X5_100"
X = se3.exp([0.03, -0.05, 0.08, 0.2, -0.4, 1.2])
Z = se3.exp([0.7, 0.2, 0.1, 2.0, 0.5, -0.3])
# The stop whose robot pose is wrong, from 0.
WRONG = 6
N_STOPS = 12


@pytest.fixture(scope="module")
def arm_images(tmp_path_factory):
    """Folder with images and intrinsics, the images, and the poses of the target."""
    folder = tmp_path_factory.mktemp("arm")
    rng = np.random.default_rng(77)
    Ts_camera_target = views(N_STOPS, [0.175, 0.125, 0.0], rng)
    picture = charuco_picture()
    images = [rendered(picture, T, rng) for T in Ts_camera_target]
    (folder / "images").mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / "images" / f"view_{number}.png"), image)
    (folder / "camera.yaml").write_text(CAMERA_INFO)
    return folder, images, Ts_camera_target


def robot_of(Ts_camera_target, setup):
    """Poses of the hand in the base, the one of the stop WRONG displaced by 2 cm."""
    rng = np.random.default_rng(78)
    hand = Z @ se3.inverse(X @ Ts_camera_target)
    if setup == "beside":
        # X is the camera in the base, Z the target in the hand.
        hand = X @ Ts_camera_target @ se3.inverse(Z)
    hand = hand @ se3.exp(rng.normal(0.0, 2e-4, (N_STOPS, 6)))
    hand[WRONG] = hand[WRONG] @ se3.exp([0.02, 0, 0, 0, 0, 0])
    return hand


@pytest.mark.parametrize("setup", ["hand", "beside"])
def test_corners_through_the_result_are_those_of_the_robot(arm_images, setup):
    folder, images, Ts_camera_target = arm_images
    hand = robot_of(Ts_camera_target, setup)
    finder = TargetFinder.parse(TARGET, folder / "camera.yaml")
    for image in images:
        finder.look(image)
    found = finder.found()
    result = hec.calibrate_arm(hand, found.Ts_camera_target, setup=setup)
    stops = reprojections(result, found, finder.camera)
    # From the poses of the robot, X and Z by another way than that of the program.
    Ts = se3.inverse(hand @ result.T_parent_child) @ result.T_world_world
    if setup == "beside":
        Ts = se3.inverse(result.T_parent_child) @ hand @ result.T_world_world
    for T, corners, stop in zip(Ts, found.corners, stops, strict=True):
        in_camera = corners @ T[:3, :3].T + T[:3, 3]
        pixels = in_camera @ MATRIX.T
        expected = pixels[:, :2] / pixels[:, 2:]
        assert stop.predicted == pytest.approx(expected, abs=0.01)
    sizes = np.array([stop.rms_px for stop in stops])
    assert sizes.argmax() == WRONG
    # 2 cm at 0.6 m and 900 pixels.
    assert 15.0 < sizes[WRONG] < 60.0
    assert np.delete(sizes, WRONG).max() < 3.0


def test_the_worst_stop_is_drawn_first_and_named(arm_images, capsys):
    folder, _, Ts_camera_target = arm_images
    hand = robot_of(Ts_camera_target, "hand")
    stamps_ns = 10**9 * np.arange(1, N_STOPS + 1)
    write_trajectory(folder / "hand.tum", Trajectory(stamps_ns, hand))
    paths = [str(folder / "hand.tum"), str(folder / "images")]
    options = ["--target", TARGET, "--camera", str(folder / "camera.yaml")]
    out = folder / "out"
    assert main(["arm", *paths, *options, "--out", str(out)]) == 0
    page = (out / "report.html").read_text()
    (figure,) = re.findall(
        r'<figure[^>]*id="figure-corners".*?</figure>', page, re.S
    )
    assert f"the worst, stop {WRONG + 1}," in figure
    assert "the fit leaves this stop out" in figure
    tiles = re.findall(r'<g transform="translate.*?</g>.*?</g>', figure, re.S)
    assert len(tiles) == 4
    assert f"worst: stop {WRONG + 1}, view_{WRONG}.png" in tiles[0]
    far = []
    for tile in tiles:
        circles = np.array(
            re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', tile),
            dtype=float,
        )
        # A cross begins at its left end.
        left = re.findall(r"M([\d.-]+) ([\d.-]+)h12", tile)
        crosses = np.add(np.array(left, dtype=float), [6.0, 0.0])
        assert len(circles) == 24
        distances = np.linalg.norm(circles[:, None] - crosses, axis=2).min(
            axis=1
        )
        far.append(np.median(distances))
        (data,) = re.findall(r"base64,([^\"]+)", tile)
        part = cv2.imdecode(
            np.frombuffer(base64.b64decode(data), np.uint8),
            cv2.IMREAD_GRAYSCALE,
        )
        # A corner of a board is between dark and bright squares, at the place of its circle.
        (width,) = re.findall(r'<image width="([\d.]+)"', tile)
        for u, v in circles * part.shape[1] / float(width):
            near = part[
                round(v) - 4 : round(v) + 5, round(u) - 4 : round(u) + 5
            ]
            assert np.ptp(near.astype(int)) > 100
    assert far[0] > 6.0 > 3.0 > max(far[1:])
    assert sum(map(len, tiles)) < 400_000
    assert browser.printed_pages(out / "report.html", folder) == 2


def test_poses_that_the_result_does_not_use_as_they_are_have_no_picture(
    arm_images,
):
    folder, images, Ts_camera_target = arm_images
    finder = TargetFinder.parse(TARGET, folder / "camera.yaml")
    for image in images:
        finder.look(image)
    found = finder.found()
    result = hec.calibrate_arm(
        robot_of(Ts_camera_target, "hand")[1:], found.Ts_camera_target[1:]
    )
    assert (
        figures_of_corners(result, found, finder.camera, [], images.__getitem__)
        == []
    )
