"""Stops of a hand from images of a target, rendered here."""

from functools import partial

import numpy as np
import pytest
from bag_making import JAZZY, header, write_messages
from numpy.testing import assert_array_equal
from scipy.spatial.transform import Rotation
from target_rendering import (
    CAMERA_INFO,
    MATRIX,
    PIXELS_PER_M,
    aprilgrid_picture,
    charuco_picture,
    rendered,
    views,
)

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.geometry.trajectory import Trajectory
from hand_eye_calib.extras.sensors.cameras import Camera, read_camera
from hand_eye_calib.extras.sensors.target_images import (
    Target,
    TargetFinder,
    images_in,
)
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.writer import stamped_messages
from hand_eye_calib.formats.trajectory_files.writing import write_trajectory
from hand_eye_calib.offline.cli.main import main

cv2 = pytest.importorskip("cv2", reason="needs opencv-python-headless")

VISP_CAMERA = """<?xml version="1.0"?><root><camera><name>Camera</name>
<model><type>perspectiveProjWithoutDistortion</type>
<px>901</px><py>901</py><u0>641</u0><v0>481</v0></model>
<model><type>perspectiveProjWithDistortion</type>
<px>900</px><py>900</py><u0>640</u0><v0>480</v0><kud>-0.1</kud><kdu>0.1</kdu></model>
</camera></root>
"""


def poses_of_target(images, target, camera):
    finder = TargetFinder(target, camera)
    for image in images:
        finder.look(image)
    return finder.found()


def test_thirty_images_calibrate_a_hand(tmp_path, capsys, no_figures):
    rng = np.random.default_rng(4)
    picture = charuco_picture()
    Ts_camera_target = views(30, [0.175, 0.125, 0.0], rng)
    X = se3.exp([0.03, -0.05, 0.08, 0.2, -0.4, 1.2])
    Z = se3.exp([0.7, 0.2, 0.1, 2.0, 0.5, -0.3])
    hand = Z @ se3.inverse(Ts_camera_target) @ se3.inverse(X)
    write_trajectory(
        tmp_path / "hand.tum", Trajectory(10**9 * np.arange(1, 31), hand)
    )
    (tmp_path / "camera.yaml").write_text(CAMERA_INFO)
    folder = tmp_path / "images"
    folder.mkdir()
    for number, T in enumerate(Ts_camera_target):
        cv2.imwrite(str(folder / f"{number}.png"), rendered(picture, T, rng))
    paths = [
        str(tmp_path / "hand.tum"),
        str(folder),
        "--camera",
        str(tmp_path / "camera.yaml"),
    ]
    target = ["--target", "charuco:7x5:0.05:0.037:5X5_100"]
    assert (
        main(["calibrate", *paths, *target, "--out", str(tmp_path / "out")])
        == 0
    )
    assert "visible in 30 of 30 images" in capsys.readouterr().err
    off = se3.log(se3.inverse(X) @ hec.load(tmp_path / "out").T_parent_child)
    assert np.linalg.norm(off[:3]) < 1e-3
    assert np.degrees(np.linalg.norm(off[3:])) < 0.1
    for number in range(1, 29):
        (folder / f"{number}.png").unlink()
    assert main(["calibrate", *paths, *target]) == 1
    assert "30 poses and" in capsys.readouterr().err


def test_aprilgrid_has_the_frame_of_kalibr():
    """Origin at the lower left corner of the first tag, x to the right and y up."""
    rng = np.random.default_rng(5)
    columns = 6
    rows = 4
    size = 0.03
    gap = 0.009
    picture = aprilgrid_picture(columns, rows, size, gap)
    height_m = picture.shape[0] / PIXELS_PER_M
    T_picture_target = se3.from_rotation_translation(
        np.diag([1.0, -1.0, -1.0]), [0, height_m, 0]
    )
    Ts = views(3, [0.1, 0.07, 0.0], rng)
    target = Target.parse(f"aprilgrid:{columns}x{rows}:{size}:{gap}")
    images = [rendered(picture, T, rng) for T in Ts]
    tracking = poses_of_target(
        images, target, Camera(MATRIX, np.zeros(5), False)
    )
    off = se3.log(
        Ts[tracking.images]
        @ T_picture_target
        @ se3.inverse(tracking.Ts_camera_target)
    )
    assert tracking.images == [0, 1, 2]
    assert np.abs(off[:, :3]).max() < 5e-3
    assert np.degrees(np.abs(off[:, 3:]).max()) < 0.4


def image_messages(stamp_ns, image):
    """The same image on two topics, and the intrinsics."""
    types = JAZZY.types
    head = header(JAZZY, stamp_ns, "eye")
    coded = cv2.imencode(".png", image)[1].ravel()
    color = np.repeat(image[:, :, None], 3, axis=2)
    height, width = image.shape
    about = "rgb8", 0, 3 * width, color.ravel()
    raw = types["sensor_msgs/msg/Image"](head, height, width, *about)
    compressed = types["sensor_msgs/msg/CompressedImage"](head, "png", coded)
    region = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    P = np.c_[MATRIX, np.zeros(3)].ravel()
    lens = (
        "plumb_bob",
        np.zeros(5),
        MATRIX.ravel(),
        np.eye(3).ravel(),
        P,
        0,
        0,
        region,
    )
    info = types["sensor_msgs/msg/CameraInfo"](head, height, width, *lens)
    for topic, message in (
        ("image_raw", raw),
        ("image_raw/compressed", compressed),
    ):
        yield (
            stamp_ns,
            f"/eye/{topic}",
            message.__msgtype__,
            lambda _, made=message: made,
        )
    yield stamp_ns, "/eye/camera_info", info.__msgtype__, lambda _: info


BOARD = "charuco:7x5:0.05:0.037:5X5_100"
X_HAND_EYE = se3.exp([0.03, -0.05, 0.08, 0.2, -0.4, 1.2])


def bag_of_hand_and_eye(path):
    """A bag with poses of a hand and images of its camera, and the target's poses (16, 4, 4)."""
    rng = np.random.default_rng(7)
    count = 16
    times = np.arange(count) / 6
    stamps_ns = 1_700_000_000_000_000_000 + np.int64(1e9 / 6 * np.arange(count))
    turns = 0.45 * np.stack(
        [np.sin(1.3 * times), np.sin(1.9 * times + 1), np.sin(times)], axis=1
    )
    Rs = Rotation.from_rotvec(turns).as_matrix()
    far = [0.0, 0.0, 0.62]
    Ts = se3.from_rotation_translation(Rs, far - Rs @ [0.175, 0.125, 0.0])
    Ts_base_hand = se3.inverse(Ts) @ se3.inverse(X_HAND_EYE)
    hand = Trajectory(stamps_ns, Ts_base_hand, "hand", "base")
    messages = [
        (
            stamp_ns,
            "/hand",
            "geometry_msgs/msg/PoseStamped",
            lambda _, made=message: made,
        )
        for stamp_ns, message in stamped_messages(
            JAZZY.types, hand, "geometry_msgs/msg/PoseStamped", is_ros1=False
        )
    ]
    picture = charuco_picture()
    for stamp_ns, T in zip(stamps_ns.tolist(), Ts, strict=True):
        messages += image_messages(stamp_ns, rendered(picture, T, rng))
    return write_messages(path, messages), Ts


def test_the_images_of_a_bag_are_poses_of_the_camera(tmp_path, no_figures):
    bag, Ts = bag_of_hand_and_eye(tmp_path / "bag")
    with pytest.warns(
        UserWarning,
        match="visible in 16 of 16 images, with corner residuals of 0[.]",
    ):
        trajectory = hec.read_trajectory(bag, topic=f"/eye/image_raw?{BOARD}")
    off = se3.log(Ts @ trajectory.poses)
    assert np.median(np.abs(off[:, :3])) < 1e-3
    assert np.degrees(np.median(np.abs(off[:, 3:]))) < 0.1
    assert (trajectory.world_frame, trajectory.sensor_frame) == (
        "target",
        "eye",
    )
    (tmp_path / "camera.yaml").write_text(CAMERA_INFO)
    with PoseBag(bag) as opened:
        of_file = (
            f"/eye/image_raw/compressed?{BOARD}@{tmp_path / 'camera.yaml'}"
        )
        assert_array_equal(
            opened.trajectory(of_file)[0].poses, trajectory.poses
        )
        for topic, message in (
            ("/eye/image_raw", "name the target in the images"),
            (f"/hand?{BOARD}", "contains no images"),
        ):
            with pytest.raises(InputError, match=message):
                opened.trajectory(topic)
    topics = ["--parent-topic", "/hand", "--child-topic", "/eye/image_raw"]
    options = [*topics, "--target", BOARD, "--out", str(tmp_path / "out")]
    assert main(["calibrate", str(bag), *options]) == 0
    result = hec.load(tmp_path / "out")
    error = se3.log(se3.inverse(X_HAND_EYE) @ result.T_parent_child)
    assert np.abs(error[:3]).max() < 3e-3
    assert np.degrees(np.abs(error[3:]).max()) < 0.2


def test_images_without_the_target_are_left_out():
    rng = np.random.default_rng(6)
    (T,) = views(1, [0.175, 0.125, 0.0], rng)
    empty = np.full((960, 1280), 200, dtype=np.uint8)
    target = Target.parse("charuco:7x5:0.05:0.037:5X5_100")
    camera = Camera(MATRIX, np.zeros(5), False)
    tracking = poses_of_target(
        [empty, rendered(charuco_picture(), T, rng)], target, camera
    )
    assert tracking.images == [1]
    with pytest.raises(InputError, match="none of 1 images"):
        poses_of_target([empty], target, camera)


@pytest.mark.parametrize(
    "text",
    [
        CAMERA_INFO,
        "cam0: {intrinsics: [900, 900, 640, 480], distortion_coeffs: [0, 0, 0, 0]}",
    ],
)
def test_intrinsics_of_ros_and_kalibr(tmp_path, text):
    (tmp_path / "camera.yaml").write_text(text)
    assert np.array_equal(read_camera(tmp_path / "camera.yaml").matrix, MATRIX)
    (tmp_path / "camera.yaml").write_text("image_width: 3")
    with pytest.raises(InputError, match="intrinsics"):
        read_camera(tmp_path / "camera.yaml")


def test_intrinsics_of_visp(tmp_path):
    path = tmp_path / "camera.xml"
    path.write_text(VISP_CAMERA)
    camera = read_camera(path)
    assert np.array_equal(camera.matrix, MATRIX)
    assert list(camera.distortion) == [-0.1, 0.0, 0.0, 0.0]
    models = VISP_CAMERA.split("</name>")[1].split("</camera>")[0]
    for text in ("<root>", "<root/>", VISP_CAMERA.replace(models, 2 * models)):
        path.write_text(text)
        with pytest.raises(InputError, match="intrinsics"):
            read_camera(path)


def test_a_folder_with_images_and_a_file_for_each_pose(
    tmp_path, capsys, no_figures
):
    rng = np.random.default_rng(11)
    picture = charuco_picture()
    Ts_camera_target = views(10, [0.175, 0.125, 0.0], rng)
    X = se3.exp([0.03, -0.05, 0.08, 0.2, -0.4, 1.2])
    hand = se3.exp([0.7, 0.2, 0.1, 2.0, 0.5, -0.3]) @ se3.inverse(
        X @ Ts_camera_target
    )
    hand = hand @ se3.exp(rng.normal(0.0, 1e-4, (10, 6)))
    folder = tmp_path / "stops"
    folder.mkdir()
    for number, (T_camera_target, T_base_hand) in enumerate(
        zip(Ts_camera_target, hand, strict=True), start=1
    ):
        cv2.imwrite(
            str(folder / f"image-{number}.png"),
            rendered(picture, T_camera_target, rng),
        )
        np.savetxt(folder / f"franka_pose_rPe_{number}.txt", T_base_hand)
    (folder / "camera.xml").write_text(VISP_CAMERA.replace("-0.1", "0"))
    arguments = [
        "--target",
        "charuco:7x5:0.05:0.037:5X5_100",
        "--out",
        str(tmp_path / "out"),
    ]
    main(
        ["arm", str(folder), "--camera", str(folder / "camera.xml"), *arguments]
    )
    assert "visible in 10 of 10 images" in capsys.readouterr().err
    off = se3.log(se3.inverse(X) @ hec.load(tmp_path / "out").T_parent_child)
    assert np.linalg.norm(off[:3]) < 2e-3
    (folder / "franka_pose_rPe_3.txt").unlink()
    assert (
        main(
            [
                "arm",
                str(folder),
                "--camera",
                str(folder / "camera.xml"),
                *arguments,
            ]
        )
        == 1
    )
    assert "9 poses and" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text",
    [
        "charuco:5x7",
        "charuco:5x7:0.03:0.04",
        "aprilgrid:6:1:1",
        "aprilgrid:6x6:0.088:0.0264:4X4_50",
        "chessboard:7x4",
        "chessboard:7x2:0.03",
        "chessboard:7x4:30:1",
        "marker:x:0.1",
        "marker:1:0",
        "marker:-1:0.1",
        "dots:3x4:0.1:0.05",
        "x",
    ],
)
def test_what_is_no_target(text):
    with pytest.raises(ConfigError, match="expected a target"):
        Target.parse(text)


def test_numbers_in_names_count_by_their_value(tmp_path):
    for name in ("10.png", "9.png", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in images_in(tmp_path)] == ["9.png", "10.png"]


def chessboard_picture(columns, rows, square):
    """Squares around columns x rows inner corners, with a white border of a square."""
    side = round(square * PIXELS_PER_M)
    y, x = np.indices((rows + 3, columns + 3))
    is_inside = (x > 0) & (x < columns + 2) & (y > 0) & (y < rows + 2)
    is_even = (x + y) % 2 == 0
    colours = np.where(is_inside & is_even, 0, 255)
    square_pixels = np.ones((side, side))
    return np.kron(colours, square_pixels).astype(np.uint8)


def marker_picture(name, number, size):
    """A marker with a white border of a quarter of its side."""
    dictionary = cv2.aruco.getPredefinedDictionary(
        getattr(cv2.aruco, f"DICT_{name}")
    )
    side = round(size * PIXELS_PER_M)
    marker = cv2.aruco.generateImageMarker(dictionary, number, side)
    return np.pad(marker, side // 4, constant_values=255)


def old_charuco_picture(columns, rows, square, marker):
    """A ChArUco board of OpenCV before 4.6."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((columns, rows), square, marker, dictionary)
    if not hasattr(board, "setLegacyPattern"):
        pytest.skip("needs OpenCV 4.8 or newer")
    board.setLegacyPattern(True)
    size = (
        round(columns * square * PIXELS_PER_M),
        round(rows * square * PIXELS_PER_M),
    )
    return board.generateImage(size)


def rolled(Ts, angles):
    """Poses in a camera that is turned about its optical axis."""
    rotation_vectors = np.outer(angles, [0.0, 0.0, 1.0])
    rotations = Rotation.from_rotvec(rotation_vectors).as_matrix()
    no_shift = np.zeros((len(rotations), 3))
    return se3.from_rotation_translation(rotations, no_shift) @ Ts


BOARDS = {
    "chessboard:7x4:0.03": partial(chessboard_picture, 7, 4, 0.03),
    "chessboard:4x7:0.03": partial(chessboard_picture, 4, 7, 0.03),
    "charuco-old:5x6:0.04:0.03:5X5_100": partial(
        old_charuco_picture, 5, 6, 0.04, 0.03
    ),
}
MARKERS = {
    "marker:7:0.16:5X5_50": partial(marker_picture, "5X5_50", 7, 0.16),
    "marker:26:0.16:APRILTAG_36h11": partial(
        marker_picture, "APRILTAG_36h11", 26, 0.16
    ),
}


@pytest.mark.parametrize("text", [*BOARDS, *MARKERS])
def test_motions_of_other_targets(text):
    """The camera turns about its optical axis, so that no side of the target stays up."""
    rng = np.random.default_rng(8)
    picture = (BOARDS | MARKERS)[text]()
    height, width = picture.shape
    center = np.array([width, height, 0.0]) / PIXELS_PER_M / 2.0
    angles = 2.0 * np.pi * np.arange(8) / 8
    truth = rolled(views(8, center, rng), angles)
    camera = Camera(MATRIX, np.zeros(5), is_fisheye=False)
    images = [rendered(picture, T, rng) for T in truth]

    tracking = poses_of_target(images, Target.parse(text), camera)

    assert len(tracking.images) >= 7
    # Origin and axes of a target differ from those of its picture by a constant pose.
    from_camera = se3.inverse(truth[tracking.images])
    offsets = from_camera @ tracking.Ts_camera_target
    deviations = se3.inverse(offsets[0]) @ offsets
    errors = np.abs(se3.log(deviations))
    most_m, most_rad = (0.001, 0.003) if text in BOARDS else (0.003, 0.01)
    assert errors[:, :3].max() < most_m
    assert errors[:, 3:].max() < most_rad


def test_only_the_marker_of_the_target_is_used():
    (T,) = views(1, [0.12, 0.12, 0.0], np.random.default_rng(9))
    image = rendered(
        marker_picture("5X5_50", 7, 0.16), T, np.random.default_rng(10)
    )
    camera = Camera(MATRIX, np.zeros(5), is_fisheye=False)
    for number in (6, 8):
        with pytest.raises(
            InputError,
            match=f"4 corners of the target marker {number} of 5X5_50",
        ):
            poses_of_target(
                [image], Target.parse(f"marker:{number}:0.16:5X5_50"), camera
            )
    with pytest.raises(ConfigError, match="no marker 50; the last is 49"):
        TargetFinder(Target.parse("marker:50:0.16:5X5_50"), camera)


def test_a_chessboard_that_looks_the_same_after_half_a_turn_is_refused():
    with pytest.raises(
        ConfigError, match="7x5 inner corners looks the same after half a turn"
    ):
        Target.parse("chessboard:7x5:0.03")


@pytest.mark.parametrize(
    "text", ["marker:7:0.16:5X5_50", "chessboard:7x4:0.03"]
)
def test_sigmas_are_as_large_as_the_errors(text, monkeypatch):
    """Corners with errors of 0.2 pixels. Only two of a marker's eight residuals are redundant."""
    rng = np.random.default_rng(61)
    target = Target.parse(text)
    camera = Camera(MATRIX, np.zeros(5), is_fisheye=False)
    finder = TargetFinder(target, camera)
    corners = finder._corners
    numbers = target.number + np.arange(len(corners))
    monkeypatch.setattr(finder, "_detect", lambda pixels: (pixels, numbers))
    center = corners.reshape(-1, 3).mean(axis=0)
    truth = views(400, center, rng)
    for T in truth:
        in_camera = corners @ T[:3, :3].T + T[:3, 3]
        rays = in_camera @ MATRIX.T
        pixels = rays[..., :2] / rays[..., 2:]
        noise = rng.normal(0.0, 0.2, pixels.shape)
        finder.look(pixels + noise)

    tracking = finder.found()

    deviations = se3.inverse(truth) @ tracking.Ts_camera_target
    errors = se3.log(deviations).reshape(-1, 2, 3)
    mean_squares = (errors**2).mean(axis=(0, 2))
    variances = (tracking.sigmas**2).mean(axis=0)
    ratios = np.sqrt(mean_squares / variances)
    assert ratios == pytest.approx([1.0, 1.0], abs=0.2), "errors over sigmas"
