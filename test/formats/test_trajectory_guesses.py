"""What a trajectory file does not say is found, and said: order of quaternions, angles and
their units, latitude and longitude, repeated stamps.
"""

import numpy as np
import pytest
from motions import (
    as_trajectory,
    geodetic,
    planar_poses,
    read_trajectory_file,
    wandering_poses,
)
from numpy.testing import assert_allclose, assert_array_equal
from published_data import data_folder

import hand_eye_calib as hec
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.formats.geodetic import LocalOrigin
from hand_eye_calib.formats.trajectory_files.file_options import (
    AUTO,
    FileOptions,
)
from hand_eye_calib.formats.trajectory_files.reading import (
    read_trajectory_files,
)
from hand_eye_calib.offline.cli.main import main

SCALAR_FIRST = [3, 0, 1, 2]
SCALAR_LAST = [0, 1, 2, 3]


def write_unnamed(path, trajectory, order, separator=" "):
    """Eight numbers in each line, and no header."""
    quats = se3.to_quat_xyzw(trajectory.poses)[:, order]
    values = np.c_[trajectory.poses[:, :3, 3], quats].tolist()
    stamps = (trajectory.stamps_ns / 1e9).tolist()
    rows = zip(stamps, values, strict=True)
    path.write_text(
        "".join(f"{separator.join(map(repr, [s, *v]))}\n" for s, v in rows)
    )
    return path


def driven(seed=0):
    """A vehicle on flat ground, its sensor mounted in some direction."""
    mount = se3.exp(np.array([0.3, 0.1, 1.0, 0.4, -1.0, 0.8]))
    # Anywhere but at the identity.
    T_world = se3.exp(np.array([10.0, -5.0, 2.0, 0.2, 0.1, 2.0]))
    sensor = planar_poses(400, seed) @ mount
    return as_trajectory(T_world @ sensor)


def read(path, **options):
    reading = read_trajectory_file(path, AUTO, repair=True, **options)
    return reading.trajectory, [
        text.removeprefix(str(path)) for text in reading.guesses
    ]


@pytest.mark.parametrize(
    ("truth", "sentence"),
    [
        (driven(), "the motion then has a steady direction"),
        *(
            (
                as_trajectory(wandering_poses(200, seed)),
                "the first orientation is then the identity",
            )
            for seed in range(3)
        ),
    ],
)
def test_motion_or_start_tell_the_order(tmp_path, truth, sentence):
    for name, separator in (("poses.txt", " "), ("poses.csv", ",")):
        for order in (SCALAR_FIRST, SCALAR_LAST):
            trajectory, guesses = read(
                write_unnamed(tmp_path / name, truth, order, separator)
            )
            assert_allclose(trajectory.poses, truth.poses, atol=1e-12)
            guesses = [
                text for text in guesses if "is read as format" not in text
            ]
            assert len(guesses) == (order == SCALAR_FIRST)
            assert all(
                "read with the scalar first" in text and sentence in text
                for text in guesses
            )


def test_an_order_that_nothing_tells_is_said(tmp_path):
    truth = as_trajectory(
        se3.exp(np.array([1.0, 2.0, 3.0, 1.0, 0.5, -1.0]))
        @ wandering_poses(200)
    )
    sentence = "does not name its columns or the order of the quaternion; read with the scalar"
    for name, separator, is_said in (("a.csv", ",", 1), ("a.txt", " ", 0)):
        trajectory, guesses = read(
            write_unnamed(tmp_path / name, truth, SCALAR_LAST, separator)
        )
        assert_allclose(trajectory.poses, truth.poses, atol=1e-12)
        assert sum(sentence in text for text in guesses) == is_said


def test_only_auto_guesses(tmp_path):
    path = write_unnamed(tmp_path / "poses.mat", driven(), SCALAR_FIRST)
    assert read_trajectory_file(path).guesses == []
    with pytest.raises(
        InputError, match="so their order is unknown; name the 8 columns with"
    ):
        read_trajectory_file(path, "csv")


def table(path, header, *columns):
    """A csv file with these columns, ten rows a second."""
    stamps = np.arange(len(columns[0])) / 10
    rows = np.c_[stamps, np.transpose(columns)].tolist()
    path.write_text(
        "\n".join(
            [f"t,{header}", *(",".join(map(repr, row)) for row in rows), ""]
        )
    )
    return path


def angles(seed=1):
    """Positions (N, 3), and roll, pitch and yaw (N, 3), of a vehicle on uneven ground."""
    poses = planar_poses(300, seed)
    positions = poses[:, :3, 3]
    numbers = np.arange(300)
    roll = 0.1 * np.sin(numbers / 7.0)
    pitch = 0.1 * np.sin(numbers / 11.0)
    yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    wrapped_yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    return positions.T, np.stack([roll, pitch, wrapped_yaw])


@pytest.mark.parametrize(
    ("header", "unit", "is_said"),
    [
        ("roll,pitch,yaw", 1.0, True),
        ("roll,pitch,yaw", 180 / np.pi, True),
        ("roll [deg],pitch [deg],yaw [deg]", 180 / np.pi, False),
        (".roll_degrees,.pitch_degrees,.yaw_degrees", 180 / np.pi, False),
    ],
)
def test_roll_pitch_and_yaw_in_degrees_or_radians(
    tmp_path, header, unit, is_said
):
    positions, rpy = angles()
    path = table(tmp_path / "a.csv", f"x,y,z,{header}", *positions, *rpy * unit)
    trajectory, guesses = read(path)
    expected = se3.from_rotation_translation(
        se3.rotation_from_rpy(rpy.T), positions.T
    )
    assert_allclose(trajectory.poses, expected, atol=1e-12)
    word = "deg" if unit > 1 else "rad"
    sentences = [
        text
        for text in guesses
        if f"roll, pitch, yaw read in {word}, the largest" in text
    ]
    assert (len(sentences), len(guesses)) == (is_said, 1 + is_said)


def test_small_angles_in_degrees_are_read_by_the_name_of_their_unit(tmp_path):
    path = table(
        tmp_path / "a.csv",
        "x [mm],y [mm],yaw_deg",
        [0.0, 500.0],
        [0.0, 0.0],
        [1.0, 2.0],
    )
    trajectory, guesses = read(path)
    assert_allclose(trajectory.poses[1, :3, 3], [0.5, 0, 0])
    assert_allclose(
        se3.rotation_to_rpy(trajectory.poses[1, :3, :3])[2], np.radians(2)
    )
    assert [text for text in guesses if "no column" in text] == [
        ": no column of heights: 0 is assumed",
        ": no columns of roll and pitch: 0 is assumed",
    ]


def test_a_compass_heading_is_clockwise_from_north_and_nose_up_is_positive(
    tmp_path,
):
    positions, rpy = angles()
    roll, pitch, yaw = rpy
    compass = np.degrees((np.pi / 2 - yaw) % (2 * np.pi))
    path = table(
        tmp_path / "a.csv",
        "easting,northing,altitude,roll_deg,pitch_deg,heading_deg",
        *positions,
        np.degrees(roll),
        np.degrees(-pitch),
        compass,
    )
    trajectory, guesses = read(path)
    assert trajectory.poses[:, :3, :3] == pytest.approx(
        se3.rotation_from_rpy(rpy.T), abs=1e-12
    )
    assert guesses[1:] == [
        ": heading read as clockwise from north; axes of the sensor: x forward, y left, z up"
    ]


def test_the_motion_tells_which_way_an_angle_is_counted(tmp_path):
    positions, (_, _, yaw) = angles()
    for header, values in (
        ("x,y,z,yaw_rad", np.pi / 2 - yaw),
        ("x,y,z,heading_rad", yaw),
    ):
        trajectory, guesses = read(
            table(tmp_path / "a.csv", header, *positions, values)
        )
        assert_allclose(
            np.cos(
                se3.rotation_to_rpy(trajectory.poses[:, :3, :3])[:, 2] - yaw
            ),
            1,
            atol=1e-12,
        )
        assert (
            "because the motion fits this convention and not the usual one"
            in guesses[-1]
        )


def test_files_with_the_same_columns_are_read_by_one_convention(tmp_path):
    """A sensor on a vehicle, and another that hangs upside down, turned by 0.8."""
    positions, (_, _, yaw) = angles()
    upright = se3.rotation_from_rpy(np.c_[np.zeros((len(yaw), 2)), yaw])
    X = se3.from_rotation_translation(
        se3.rotation_from_rpy([np.pi, 0.0, 0.8]), np.zeros(3)
    )
    header = "easting,northing,altitude,roll_rad,pitch_rad,heading_rad"
    files = []
    for name, rotation in (("a.csv", upright), ("b.csv", upright @ X[:3, :3])):
        rpy = se3.rotation_to_rpy(np.swapaxes(rotation, 1, 2))
        files.append(table(tmp_path / name, header, *positions, *rpy.T))
    alone = [read(file)[1][-1] for file in files]
    assert "read as clockwise" in alone[0]
    assert "read as counterclockwise" in alone[1]
    settings = [(file, FileOptions(format=AUTO)) for file in files]
    for order in (settings, settings[::-1]):
        for reading in read_trajectory_files(order):
            assert (
                "read as that of the world in the sensor's frame"
                in reading.guesses[-1]
            )
    first, second = (
        reading.trajectory.poses for reading in read_trajectory_files(settings)
    )
    turned = np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]
    assert_allclose(turned, np.broadcast_to(X[:3, :3], turned.shape), atol=1e-9)
    with pytest.warns(
        UserWarning, match="read as that of the world in the sensor's frame"
    ):
        result = hec.calibrate(*map(str, files), method="dnlo", checks=False)
    assert_allclose(result.T_parent_child[:3, :3], X[:3, :3], atol=1e-5)


def test_files_with_the_same_columns_that_no_convention_fits_are_refused(
    tmp_path, capsys
):
    positions, (_, _, yaw) = angles()
    files = [
        str(table(tmp_path / name, "x,y,z,heading_rad", *positions, values))
        for name, values in (("a.csv", np.pi / 2 - yaw), ("b.csv", yaw))
    ]
    assert main(["calibrate", *files]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "a.csv and " in error
    assert (
        "have the same columns, but no convention of their angles fits the motion"
        in error
    )


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("latitude,longitude,height", 1.0),
        ("Lat [deg],Lon [deg],Alt [m]", 1.0),
        ("lat_rad,lon_rad,alt", np.pi / 180),
    ],
)
def test_latitude_and_longitude_become_metres_of_the_first_position(
    tmp_path, header, unit
):
    positions, rpy = angles()
    positions = positions * [[100], [100], [1]] + [[0], [0], [5.0]]
    lat, lon, height = geodetic(positions.T, (60.17, 24.94, 20.0))
    path = table(
        tmp_path / "a.csv",
        f"{header},roll,pitch,yaw",
        lat * unit,
        lon * unit,
        height,
        *rpy,
    )
    trajectory, guesses = read(path)
    expected = positions - positions[:, :1]
    assert np.ptp(expected[0]) > 500
    # The axes of the first position are tilted against those of the place by some 1e-5 rad.
    assert_allclose(trajectory.poses[:, :3, 3].T, expected, atol=2e-2)
    assert any(
        "became metres east and north of the first position" in text
        for text in guesses
    )
    # East, north and up of the places turn against each other as the earth does.
    turned = se3.rotation_angle(
        trajectory.poses[:, :3, :3]
        @ np.swapaxes(se3.rotation_from_rpy(rpy.T), 1, 2)
    )
    assert 1e-4 < turned.max() < 1e-3


@pytest.mark.parametrize(
    ("lat", "lon", "message"),
    [
        (
            [139.7, 139.8],
            [35, 35],
            "line 2: found latitude 139.7 deg, .* check whether both are swapped",
        ),
        (
            [60.0, 60.0],
            [1, 361],
            "line 3: found latitude 60 deg, longitude 361 deg",
        ),
        (
            [60.0, 91.0],
            [1, 1],
            "line 3: found latitude 91 deg, longitude 1 deg; the limit of the lat",
        ),
        ([60.0, 60.0], [1, 1e300], r"line 3: found angle 1e\+300; repair"),
    ],
)
def test_latitudes_that_cannot_be_are_refused(tmp_path, lat, lon, message):
    path = table(
        tmp_path / "a.csv", "lat,lon,height,yaw", lat, lon, [0, 0], [0, 0]
    )
    with pytest.raises(InputError, match=message):
        read(path)


def test_the_example_of_the_epsg_for_metres_east_north_and_up_of_a_place():
    latitude_deg = 53 + 48 / 60 + 33.820 / 3600
    longitude_deg = 2 + 7 / 60 + 46.380 / 3600
    latitude = np.radians([latitude_deg])
    longitude = np.radians([longitude_deg])
    height = np.array([73.0])
    origin = LocalOrigin()
    origin.geodetic = *np.radians([55.0, 5.0]), 200.0

    local = origin.local(latitude, longitude, height)

    assert_allclose(local, [[-189013.869, -128642.040, -4220.171]], atol=1e-3)


def test_published_files_need_no_options():
    """Scalar first in the files of one data set; an INS with latitude, longitude and azimuth gives
    what its authors made of it.
    """
    folder = data_folder() / "zxl19"
    for path in sorted(folder.glob("bag*/[ILV]*_FCPE.mat")):
        trajectory = read_trajectory_file(path, AUTO, repair=True).trajectory
        columns = "t,x,y,z,qw,qx,qy,qz"
        named = read_trajectory_file(
            path, "csv", columns=columns, repair=True
        ).trajectory
        assert_array_equal(trajectory.poses, named.poses)
    ins, _ = read(folder / "raw_bag1" / "bag1-novatel_data-inspvax.csv")
    theirs = read_trajectory_file(
        folder / "bag1" / "INS_FCPE.mat", AUTO
    ).trajectory
    # Their sensor has x to the right and y forward; their roll and pitch are exchanged.
    headings = [np.arctan2(ins.poses[:, 1, 0], ins.poses[:, 0, 0])]
    headings.append(np.arctan2(theirs.poses[:, 1, 1], theirs.poses[:, 0, 1]))
    turned = np.unwrap(headings[0] - headings[1])
    assert np.degrees(np.abs(turned - turned[0])).max() < 0.06
    # A UTM grid is some 0.9996 of the ground's scale.
    lengths = [
        np.linalg.norm(np.diff(trajectory.poses[:, :2, 3], axis=0), axis=1)
        for trajectory in (ins, theirs)
    ]
    assert_allclose(lengths[0].sum(), lengths[1].sum(), rtol=6e-4)


def test_a_stamp_is_preferred_to_milliseconds_of_a_week_of_gps(tmp_path):
    """Messages of a receiver in a csv: the time of the recording, and the week in the header."""
    path = tmp_path / "inspvax.csv"
    rows = [
        f"{1_636_524_445_180_543_531 + 20_000_000 * k},2183,{269_353_560 + 20 * k},{k},0,0,0,0,0,1"
        for k in range(30)
    ]
    names = "time,.header.gps_week,.header.gps_week_seconds,x,y,z,qx,qy,qz,qw"
    path.write_text("\n".join([names, *rows, ""]))
    trajectory = hec.read_trajectory(path, AUTO)
    assert trajectory.stamps_ns[0] == 1_636_524_445_180_543_531
    assert trajectory.interval_s == pytest.approx(0.02)


def test_a_license_is_no_trajectory(tmp_path):
    path = tmp_path / "LICENSE"
    path.write_text(
        "1. Definitions.\nLicense means the terms\nand conditions for use\n"
    )

    with pytest.raises(InputError, match="does not name the columns"):
        hec.read_trajectory(path, "auto")


def test_a_stamp_in_degrees_has_the_unit_of_its_size(tmp_path):
    path = tmp_path / "odd.csv"
    path.write_text("t [deg],x,y,z\n0.5,1,2,3\n1.5,1,2,4\n2.5,1,2,5\n")

    with pytest.warns(UserWarning, match="positions only"):
        trajectory = hec.read_trajectory(path, "auto")

    assert trajectory.stamps_ns.tolist() == [
        500_000_000,
        1_500_000_000,
        2_500_000_000,
    ]
