"""Columns in other languages, columns with unknown names, and stamps that count days."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.formats.trajectory_files.reading import read_trajectory

N_POSES = 10


def written(path, header, stamps, units):
    """Write a table of a curved drive, with lengths, and angles of units (rad), and return both."""
    angles_rad = np.linspace(0.1, 0.4, 3 * N_POSES).reshape(-1, 3)
    positions = np.linspace(0.0, 5.0, 3 * N_POSES).reshape(-1, 3)
    rows = np.c_[stamps, positions, angles_rad / units]
    np.savetxt(
        path, rows, "%.12f", ";", header=header, comments="", encoding="utf-8"
    )
    return positions, angles_rad


@pytest.mark.parametrize(
    "header",
    [
        "Zeit (s);X (m);Y (m);Höhe (m);Rollwinkel (°);Nickwinkel (°);Gierwinkel (°)",
        "zeit;x;y;hoehe;roll_deg;nick_deg;gier_deg",
        "temps;x;y;hauteur;roulis [deg];tangage [deg];lacet [deg]",
        "tiempo;x;y;altura;alabeo [deg];cabeceo [deg];guiñada [deg]",
        "tempo;x;y;quota;rollio [deg];beccheggio [deg];imbardata [deg]",
    ],
)
def test_names_of_columns_in_other_languages_are_read(tmp_path, header):
    path = tmp_path / "drive.csv"
    stamps = 1.7e9 + 0.1 * np.arange(N_POSES)
    positions, angles_rad = written(path, header, stamps, np.pi / 180)
    trajectory = read_trajectory(path, "csv")
    assert_allclose(trajectory.poses[:, :3, 3], positions, atol=1e-9)
    rotations = Rotation.from_euler("xyz", angles_rad).as_matrix()
    assert_allclose(trajectory.poses[:, :3, :3], rotations, atol=1e-9)


def test_a_proposal_for_unknown_columns_reads_the_file(tmp_path):
    path = tmp_path / "drive.csv"
    header = "Zeit (s);X (mm);Y (mm);Wysokość (mm);Alfa (°);Beta (°);Gamma (°)"
    stamps = 1.7e9 + 0.1 * np.arange(N_POSES)
    positions, _ = written(path, header, stamps, np.pi / 180)
    with pytest.raises(InputError, match="unknown names") as caught:
        read_trajectory(path, "csv")
    (proposal,) = re.findall(r"such as (\S+)", str(caught.value))
    assert proposal == "t_s,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg"
    trajectory = read_trajectory(path, "csv", columns=proposal)
    assert trajectory.measures == "poses"
    assert_allclose(trajectory.poses[:, :3, 3], 1e-3 * positions, atol=1e-9)


@pytest.mark.parametrize(
    ("header", "note"),
    [
        (
            "t;x;y;z;status;quality;battery",
            "positions only, by its columns; not read: status, quality, battery (if",
        ),
        (
            "t;x;y;z;sd_a [deg];sd_b [deg];sd_c [deg]",
            "not read: sd_a [deg], sd_b",
        ),
        ("t;x;y;status;roll;pitch;yaw", None),
        (
            "t;x;y;status;yaw;fix;mode",
            "0 is assumed; not read: status, fix, mode",
        ),
        ("t;x;y;z;vx;vy;vz", "positions only, by its columns\n"),
    ],
)
def test_unread_columns_are_named_if_quantities_are_missing(
    tmp_path, header, note
):
    """Other columns beside complete poses have no note, and incomplete poses are an error."""
    path = tmp_path / "drive.csv"
    written(path, header, np.arange(N_POSES), 1.0)
    if note is None:
        with pytest.raises(InputError, match="no column for z"):
            read_trajectory(path, "csv")
        return
    with pytest.warns(UserWarning, match="by its columns|is assumed") as caught:
        read_trajectory(path, "csv")
    texts = "".join(f"{warning.message}\n" for warning in caught)
    assert texts.count("not read") <= 1
    assert note in texts


@pytest.mark.parametrize(
    ("first", "epoch"),
    [(45244.925, 25569.0), (738839.925, 719529.0), (2460263.425, 2440587.5)],
)
def test_stamps_in_days_become_seconds_with_a_note(tmp_path, first, epoch):
    """The stamps are of a spreadsheet, of MATLAB and of astronomers."""
    path = tmp_path / "drive.csv"
    days = first + np.arange(N_POSES) / 86400 / 10
    written(path, "Date;x;y;z;roll;pitch;yaw", days, 1.0)
    with pytest.warns(UserWarning, match="read as days, as in a spreadsheet"):
        trajectory = read_trajectory(path, "csv")
    stamps_s = trajectory.stamps_ns * 1e-9
    assert_allclose(stamps_s, 86400.0 * (days - epoch), rtol=0.0, atol=1e-4)
    in_seconds = read_trajectory(path, "csv", stamp_unit="s")
    assert_allclose(in_seconds.stamps_ns * 1e-9, days, rtol=0.0, atol=1e-8)


def test_seconds_of_a_day_remain_seconds(tmp_path):
    path = tmp_path / "drive.csv"
    stamps = 45244.925 + 0.001 * np.arange(N_POSES)
    written(path, "t;x;y;z;roll;pitch;yaw", stamps, 1.0)
    trajectory = read_trajectory(path, "csv")
    assert_allclose(trajectory.stamps_ns * 1e-9, stamps, rtol=0.0, atol=1e-8)
