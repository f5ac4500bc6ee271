"""The public names and their modules, for editors and type checkers."""

from hand_eye_calib.core.assessment.comparison import compare as compare
from hand_eye_calib.core.base.config import CalibratorConfig as CalibratorConfig
from hand_eye_calib.core.base.errors import (
    HandEyeCalibError as HandEyeCalibError,
)
from hand_eye_calib.core.engine.calibrator import Calibrator as Calibrator
from hand_eye_calib.core.geometry.trajectory import Trajectory as Trajectory
from hand_eye_calib.core.results.calibration import Calibration as Calibration
from hand_eye_calib.core.results.reasons import Reason as Reason
from hand_eye_calib.core.results.reasons import Verdict as Verdict
from hand_eye_calib.core.results.records import Residuals as Residuals
from hand_eye_calib.core.results.records import SolveStatus as SolveStatus
from hand_eye_calib.extras.fleet.together import (
    calibrate_many as calibrate_many,
)
from hand_eye_calib.extras.fleet.together import (
    calibrate_together as calibrate_together,
)
from hand_eye_calib.extras.ground.calibrate import (
    calibrate_on_ground as calibrate_on_ground,
)
from hand_eye_calib.extras.ground.tracks import (
    gravity_from_accelerations as gravity_from_accelerations,
)
from hand_eye_calib.extras.ground.tracks import (
    gravity_from_attitude as gravity_from_attitude,
)
from hand_eye_calib.extras.ground.tracks import (
    ground_from_clouds as ground_from_clouds,
)
from hand_eye_calib.extras.rig.rig import RigCalibration as RigCalibration
from hand_eye_calib.extras.rig.rig import calibrate_rig as calibrate_rig
from hand_eye_calib.extras.simulation.drive import simulate as simulate
from hand_eye_calib.extras.stops.calibrate import calibrate_arm as calibrate_arm
from hand_eye_calib.extras.stops.calibrate import (
    calibrate_stops as calibrate_stops,
)
from hand_eye_calib.extras.stops.robot_angles import robot_poses as robot_poses
from hand_eye_calib.extras.stops.samples import (
    read_arm_samples as read_arm_samples,
)
from hand_eye_calib.extras.vehicle.calibrate import (
    calibrate_vehicle as calibrate_vehicle,
)
from hand_eye_calib.extras.vehicle.wheel_files import (
    wheel_trajectory as wheel_trajectory,
)
from hand_eye_calib.formats.results import load as load
from hand_eye_calib.formats.results import save as save
from hand_eye_calib.formats.trajectory_files.reading import (
    read_trajectory as read_trajectory,
)
from hand_eye_calib.formats.trajectory_files.writing import (
    write_trajectory as write_trajectory,
)
from hand_eye_calib.offline.calibrate import calibrate as calibrate
from hand_eye_calib.offline.calibrate import cross_check as cross_check
from hand_eye_calib.offline.report.views import plot as plot

__version__: str
