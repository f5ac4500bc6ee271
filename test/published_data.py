"""The published trajectories and results that regression tests compare with. They are not part of
this package.

They are looked for in ``$HAND_EYE_CALIB_DATA``, else in ``../shared/data`` beside the project; a
test that needs them is skipped, and says so, where they are absent.
"""

import os
from pathlib import Path

import pytest

from reproduction import published

# Cases and references of DNL in which Ipopt ended in a false minimum, with a rotation 170 to 178
# deg off and a cost at least ten times ours.
FALSE_MINIMA_OF_DNL = {
    ("outliers/6/run_48", "A"),
    ("outliers/8/run_48", "A"),
    ("outliers/10/run_6", "A"),
    ("mixture/run_48", "A"),
}


def data_folder():
    """Folder that holds ``valimaki2023`` and the other data sets; skips the running test where it
    is absent.
    """
    beside_the_project = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("HAND_EYE_CALIB_DATA", beside_the_project))
    if not (folder / "valimaki2023").is_dir():
        pytest.skip(
            f"no published data in {folder}; set HAND_EYE_CALIB_DATA to the folder that "
            "holds valimaki2023"
        )
    return folder


def kitti_short():
    """KITTI 2011_09_30_drive_0027: parent lidar, child grey camera (Välimäki et al. 2023, 5)."""
    folder = data_folder() / "valimaki2023"
    return published.load_kitti_short(folder)


def kitti_long():
    """KITTI 2011_10_03_drive_0027: parent grey camera, child colour camera (the same)."""
    folder = data_folder() / "valimaki2023"
    return published.load_kitti_long(folder)


def simulated(datasets=published.SIMULATED, levels=None):
    """The simulated cases, 38 for every data set and level (Välimäki et al. 2023, section 4)."""
    folder = data_folder() / "valimaki2023"
    return published.load_simulated(folder, datasets, levels)
