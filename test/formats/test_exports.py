"""Results as files of other programs: each maps one point by hand, and reads back."""

import json
import re

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from result_making import dofs, good_calibration
from scipy.spatial.transform import Rotation
from source_code import ROOT

from hand_eye_calib.core.base.config import EXPORT_FORMATS
from hand_eye_calib.core.base.errors import ConfigError, InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.results.calibration import SolveStatus
from hand_eye_calib.formats.exports import arranged, formats, role_of
from hand_eye_calib.formats.installed import open_installed
from hand_eye_calib.formats.results import save_result
from hand_eye_calib.offline.cli.main import main

OFFSET_S = 0.0125
POINT = np.array([0.3, -1.2, 2.5, 1.0])

# Format, parent, child, and whether the file's numbers map the child's coordinates into the
# parent's.
CASES = [
    ("autoware", "sensor_kit_base_link", "velodyne_top", True),
    ("fast_lio", "imu_link", "livox_frame", True),
    ("fast_lio", "livox_frame", "imu_link", False),
    ("fast_livo2", "cam0", "lidar", True),
    ("fast_livo2", "lidar", "cam0", False),
    ("lio_sam", "imu_link", "velodyne", False),
    ("lio_sam", "velodyne", "imu_link", True),
    ("kalibr", "imu0", "cam0", False),
    ("kalibr", "camera_optical", "imu", True),
    ("kalibr", "cam0", "cam1", False),
    ("openvins", "imu0", "cam0", True),
    ("openvins", "cam0", "imu0", False),
    ("vins", "body", "cam0", True),
    ("orbslam3", "imu", "cam0", True),
    ("apollo", "novatel", "velodyne128", True),
    ("dlio", "base_link", "lidar", True),
    ("glim", "imu", "os_lidar", False),
    ("glim", "os_lidar", "imu", True),
    ("msa", "base_link", "front_3d_lidar", True),
    ("kitti", "velo", "cam0", False),
    ("nuscenes", "ego", "LIDAR_TOP", True),
    ("colmap", "cam0", "cam1", False),
    ("driveworks", "rig", "camera_front", True),
    ("easy_handeye2", "tool0", "camera_link", True),
    ("opencv", "a", "b", True),
    ("numpy", "a", "b", True),
]


def result(parent="imu", child="camera", **changes):
    return good_calibration(
        parent_frame=parent,
        child_frame=child,
        time_offset_s=OFFSET_S,
        **changes,
    )


def unknown(*axes):
    """What makes some axes unobservable."""
    return {
        "status": SolveStatus.UNOBSERVABLE,
        "observability_measured": dofs([0.001] * 6, axes),
    }


def document(text):
    """A file as any reader of YAML has it, without what only OpenCV understands."""
    return yaml.safe_load(
        re.sub(r"^%YAML.*|!!opencv-matrix", "", text, flags=re.MULTILINE)
    )


def autoware_pose(text):
    ((_, children),) = document(text).items()
    ((_, values),) = children.items()
    translation = [values["x"], values["y"], values["z"]]
    angles = [values["roll"], values["pitch"], values["yaw"]]
    return translation, Rotation.from_euler("xyz", angles)


def fast_lio_pose(text):
    fields = document(text)
    section = fields.get("mapping") or fields["extrin_calib"]
    if "Pcl" in section:
        return section["Pcl"], section["Rcl"]
    return section["extrinsic_T"], section["extrinsic_R"]


def lio_sam_pose(text):
    section = document(text)["lio_sam"]
    assert section["extrinsicRPY"] == section["extrinsicRot"]
    return section["extrinsicTrans"], section["extrinsicRot"]


def dlio_pose(text):
    extrinsics = document(text)["dlio"]["extrinsics"]
    ((_, values),) = extrinsics.items()
    return values["t"], values["R"]


def parts_of(T):
    """Translation, and rotation (9,) by rows."""
    rotation = T[:3, :3]
    return T[:3, 3], rotation.ravel()


def kalibr_pose(text):
    ((_, camera),) = document(text).items()
    matrices = [value for key, value in camera.items() if key.startswith("T_")]
    return parts_of(np.array(matrices[0]))


def opencv_pose(text):
    values = document(text).values()
    blocks = [value for value in values if isinstance(value, dict)]
    T = np.array(blocks[0]["data"])
    return parts_of(T.reshape(4, 4))


def named_components(text):
    pose = document(text)["transform"]
    translation = pose["translation"]
    rotation = pose["rotation"]
    position = [translation[axis] for axis in "xyz"]
    quat_xyzw = [rotation[component] for component in "xyzw"]
    return position, Rotation.from_quat(quat_xyzw)


def position_and_quaternion(row):
    """Translation and rotation of x y z qx qy qz qw."""
    return row[:3], Rotation.from_quat(row[3:])


def glim_pose(text):
    sensors = json.loads(text)["sensors"]
    return position_and_quaternion(sensors["T_lidar_imu"])


def msa_pose(text):
    ((_, entry),) = document(text).items()
    return position_and_quaternion(entry["value"])


def kitti_pose(text):
    lines = dict(line.split(":", 1) for line in text.splitlines())
    translation = [float(number) for number in lines["T"].split()]
    rotation = [float(number) for number in lines["R"].split()]
    return translation, rotation


def rotation_of_wxyz(quat_wxyz):
    quat_xyzw = np.roll(quat_wxyz, -1)
    return Rotation.from_quat(quat_xyzw)


def nuscenes_pose(text):
    (record,) = json.loads(text)
    return record["translation"], rotation_of_wxyz(record["rotation"])


def colmap_pose(text):
    (rig, *_) = json.loads(text)
    camera = rig["cameras"][1]
    rotation = rotation_of_wxyz(camera["cam_from_rig_rotation"])
    return camera["cam_from_rig_translation"], rotation


def driveworks_pose(text):
    sensor = json.loads(text)["rig"]["sensors"][0]
    pose = sensor["nominalSensor2Rig_FLU"]
    angles_deg = pose["roll-pitch-yaw"]
    return pose["t"], Rotation.from_euler("xyz", angles_deg, degrees=True)


def numpy_pose(text):
    T = np.loadtxt(text.splitlines())
    return parts_of(T)


# Functions that take translation and rotation out of a file by hand.
READERS = {
    "autoware": autoware_pose,
    "fast_lio": fast_lio_pose,
    "fast_livo2": fast_lio_pose,
    "lio_sam": lio_sam_pose,
    "dlio": dlio_pose,
    "kalibr": kalibr_pose,
    "openvins": kalibr_pose,
    "vins": opencv_pose,
    "orbslam3": opencv_pose,
    "opencv": opencv_pose,
    "apollo": named_components,
    "easy_handeye2": named_components,
    "glim": glim_pose,
    "msa": msa_pose,
    "kitti": kitti_pose,
    "nuscenes": nuscenes_pose,
    "colmap": colmap_pose,
    "driveworks": driveworks_pose,
    "numpy": numpy_pose,
}


@pytest.mark.parametrize(("name", "parent", "child", "is_direct"), CASES)
def test_a_file_maps_a_point_as_it_says_and_reads_back(
    name, parent, child, is_direct, tmp_path
):
    calibration = result(parent, child)
    file = tmp_path / "foreign.yaml"
    if is_direct:
        source, target = child, parent
        T = calibration.T_parent_child
    else:
        source, target = parent, child
        T = calibration.T_child_parent

    text = calibration.export(name)

    translation, rotation = READERS[name](text)
    if isinstance(rotation, Rotation):
        rotation = rotation.as_matrix()
    R = np.reshape(rotation, (3, 3))
    mapped = R @ POINT[:3] + translation
    expected = T @ POINT
    assert_allclose(mapped, expected[:3], atol=1e-9)
    assert f"Maps coordinates of {source} into {target}" in text
    assert ("Inverted" in text) is not is_direct
    assert "Assumed" not in text

    file.write_text(text)
    pose_between = open_installed(str(file))
    installed = pose_between(parent, child)
    assert_allclose(
        installed.T_parent_child, calibration.T_parent_child, atol=1e-9
    )
    # These two formats name no frames.
    if name not in ("opencv", "numpy"):
        installed = pose_between(child, parent)
        assert_allclose(
            installed.T_parent_child, calibration.T_child_parent, atol=1e-9
        )


def test_every_format_is_tried():
    assert {name for name, *_ in CASES} | {"px4"} == {*EXPORT_FORMATS}
    assert tuple(formats()) == EXPORT_FORMATS


@pytest.mark.parametrize(
    ("name", "parent", "child", "key", "expected_s"),
    [
        # t_imu = t_cam + shift
        ("kalibr", "imu", "cam0", ("cam0", "timeshift_cam_imu"), OFFSET_S),
        ("kalibr", "cam0", "imu", ("cam0", "timeshift_cam_imu"), -OFFSET_S),
        ("openvins", "imu", "cam0", ("cam0", "timeshift_cam_imu"), OFFSET_S),
        ("vins", "cam0", "imu", ("td",), -OFFSET_S),
        # t_lidar = t_imu - offset
        (
            "fast_lio",
            "imu",
            "lidar",
            ("common", "time_offset_lidar_to_imu"),
            OFFSET_S,
        ),
        (
            "fast_livo2",
            "lidar",
            "imu",
            ("time_offset", "imu_time_offset"),
            -OFFSET_S,
        ),
        # t_lidar = t_image + offset
        (
            "fast_livo2",
            "lidar",
            "camera",
            ("time_offset", "img_time_offset"),
            OFFSET_S,
        ),
        (
            "fast_livo2",
            "camera",
            "lidar",
            ("time_offset", "img_time_offset"),
            -OFFSET_S,
        ),
    ],
)
def test_the_sign_of_a_time_offset_is_that_of_the_program(
    name, parent, child, key, expected_s
):
    value = document(result(parent, child).export(name))
    for name_of_level in key:
        value = value[name_of_level]
    assert value == pytest.approx(expected_s)


def test_px4_has_its_own_axes_and_a_delay():
    calibration = result("base_link", "vio")
    x, y, z = calibration.translation
    lines = dict(
        line.split()[2:]
        for line in calibration.export("px4").splitlines()
        if line[0] == "p"
    )
    values = [float(lines[f"EKF2_EV_POS_{axis}"]) for axis in "XYZ"]
    assert values == pytest.approx([x, -y, -z])
    assert (
        "EKF2_EV_DELAY" not in lines
    )  # the camera's clock is behind: no delay
    late = good_calibration(
        parent_frame="base_link", child_frame="vio", time_offset_s=-0.05
    )
    assert "param set EKF2_EV_DELAY 50.0\n" in late.export("px4")
    antenna = result(
        "base_link", "gnss_antenna", **unknown("roll", "pitch", "yaw")
    )
    assert f"param set EKF2_GPS_POS_Y {-y:.12f}" in antenna.export("px4")


def test_an_axis_that_is_not_known_is_refused():
    flat = result("base_link", "lidar", **unknown("z"))
    for name in EXPORT_FORMATS:
        with pytest.raises(
            InputError, match="does not determine z; .* with priors"
        ):
            flat.export(name)
    with pytest.raises(
        ConfigError, match="unknown format 'kalbir'; known are autoware"
    ):
        flat.export("kalbir")


def test_what_the_names_do_not_say_is_assumed_and_said():
    text = result("a", "b").export("fast_lio")
    assumption = (
        "Assumed, because the names of the frames do not contain "
        "it: a is the imu, b is the lidar."
    )
    assert assumption in text
    for frame in ("CAM_FRONT", "frontCamera", "camera_base_link"):
        assert role_of(frame) == "camera"
    assert (role_of("base_link"), role_of("odom")) == ("base", "")
    # The name of one of both decides.
    assert arranged(formats()["kalibr"], "cam0", "b")[1] is False


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "mapping: {extrinsic_T: [1, 2], extrinsic_R: [1]}",
            "expected a pose: 12 or 16",
        ),
        (
            "cam0: {T_cam_imu: [[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]}",
            "not a rotation matrix",
        ),
        (
            "param set EKF2_EV_POS_X 0.1",
            "no transform with position and rotation in it",
        ),
        (
            "some: text",
            "in it; pass extrinsic.yaml, a URDF, a bag, or",
        ),
        ("[1, 2, 3]", "no transform with position and rotation in it"),
        (
            "base_link: {other: {x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}}",
            "no frame 'imu' in",
        ),
    ],
)
def test_a_file_that_does_not_say_it_is_refused_in_one_line(
    text, message, tmp_path
):
    path = tmp_path / "foreign.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        open_installed(str(path))("imu", "lidar")
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_of_several_cameras_the_named_one_is_read(tmp_path):
    identity = np.eye(4).tolist()
    moved = se3.from_rotation_translation(np.eye(3), [1, 2, 3])
    path = tmp_path / "camchain.yaml"
    path.write_text(
        yaml.safe_dump(
            {
                "cam0": {"T_cam_imu": identity},
                "cam1": {"T_cam_imu": moved.tolist()},
            }
        )
    )
    T_parent_child = open_installed(str(path))("imu", "cam1").T_parent_child
    assert_allclose(T_parent_child, se3.inverse(moved))
    with pytest.raises(
        InputError, match="it has several extrinsics, and the names"
    ):
        open_installed(str(path))("imu", "lidar")


def test_the_parsers_of_others_read_the_same(tmp_path):
    cv2 = pytest.importorskip("cv2")
    calibration = result("imu", "camera")
    keys = {
        "opencv": "T_parent_child",
        "vins": "body_T_cam0",
        "orbslam3": "IMU.T_b_c1",
    }
    for name, key in keys.items():
        path = tmp_path / f"{name}.yaml"
        path.write_text(calibration.export(name))
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        T = storage.getNode(key).mat()
        assert_allclose(T, calibration.T_parent_child, atol=1e-6)
        if name == "vins":
            assert storage.getNode("td").real() == OFFSET_S
    # OpenVINS reads its YAML with OpenCV, too, a row of numbers at a time.
    path.write_text(calibration.export("openvins"))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    rows = storage.getNode("cam0").getNode("T_imu_cam")
    T = [
        [rows.at(row).at(column).real() for column in range(4)]
        for row in range(4)
    ]
    assert_allclose(T, calibration.T_parent_child, atol=1e-9)


def test_urdf_and_colmap_read_the_same(tmp_path):
    """With yourdfpy and pycolmap, which are too large to be installed for this alone."""
    yourdfpy = pytest.importorskip("yourdfpy")
    calibration = result("base_link", "camera")
    save_result(calibration, tmp_path)
    joint = (tmp_path / "extrinsic.urdf.xacro").read_text()
    links = '<link name="base_link"/><link name="camera"/>'
    path = tmp_path / "robot.urdf"
    path.write_text(
        joint.replace("<robot", '<robot name="r"').replace(
            "<joint", links + "<joint"
        )
    )
    T = yourdfpy.URDF.load(str(path)).get_transform("camera", "base_link")
    assert_allclose(T, calibration.T_parent_child, atol=1e-9)

    pycolmap = pytest.importorskip("pycolmap")
    path = tmp_path / "rig_config.json"
    path.write_text(calibration.export("colmap"))
    (rig,) = pycolmap.read_rig_config(path)
    parent, child = rig.cameras
    assert (parent.ref_sensor, parent.image_prefix) == (True, "base_link")
    T = child.cam_from_rig.matrix()
    assert_allclose(T, calibration.T_child_parent[:3], atol=1e-9)


def test_info_prints_a_format_and_compare_reads_it(tmp_path, capsys):
    save_result(result("imu", "camera"), tmp_path / "result")
    assert main(["info", str(tmp_path / "result"), "--as", "kalibr"]) == 0
    text = capsys.readouterr().out
    assert text == result("imu", "camera").export("kalibr")
    (tmp_path / "camchain.yaml").write_text(text)
    command = [
        "compare",
        str(tmp_path / "result"),
        "--with",
        str(tmp_path / "camchain.yaml"),
    ]
    assert main(command) == 0
    assert "same" in capsys.readouterr().out


DOCS = ROOT / "docs" / "exports"
CAMERA = se3.from_rotation_translation(
    [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.12, 0.05, 0.3]
)
LIDAR = se3.from_rotation_translation(
    [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.12, 0.05, 0.3]
)
# Frames of each page's example.
PAGES = {
    "autoware": ("sensor_kit_base_link", "velodyne_top", LIDAR),
    "lidar_inertial": ("imu_link", "lidar", LIDAR),
    "visual_inertial": ("imu_link", "cam0", CAMERA),
    "px4": ("base_link", "vio", CAMERA),
    "vehicles": ("velodyne", "cam0", CAMERA),
    "vision": ("tool0", "camera", CAMERA),
}
SHOWN = re.compile(r"(--as (\w+)\n```\n\n```\w+\n)(.*?)```", re.DOTALL)


def shown(page):
    """The page with what the program writes in place of its block."""
    parent, child, T = PAGES[page.stem]
    calibration = good_calibration(
        parent_frame=parent,
        child_frame=child,
        T_parent_child=T,
        time_offset_s=-0.0125 if page.stem == "px4" else 0.0125,
        time_offset_sigma_s=0.0002,
    )
    text, count = SHOWN.subn(
        lambda match: f"{match[1]}{calibration.export(match[2])}```",
        page.read_text(),
    )
    assert count == 1
    return text


@pytest.mark.parametrize(
    "page", sorted(DOCS.glob("*.md")), ids=lambda page: page.stem
)
def test_pages_show_what_the_program_writes(page):
    version = re.compile(r"(?<=by hand_eye_calib )[\w.+]+(?=\. )")
    assert version.sub("", page.read_text()) == version.sub("", shown(page))


def test_every_format_is_on_a_page():
    pages = {page.stem: page.read_text() for page in DOCS.glob("*.md")}
    assert pages.keys() == PAGES.keys()
    rows = re.findall(r"(?m)^\| (\w+) \|", "".join(pages.values()))
    assert {*rows, "autoware", "px4"} - {"Format"} == {*EXPORT_FORMATS}
    assert all("**If it is inverted**" in text for text in pages.values())


if __name__ == "__main__":
    for each in DOCS.glob("*.md"):
        each.write_text(shown(each))
