"""The public names and their modules, for editors and type checkers."""

from hand_eye_calib.assessment.comparison import compare as compare
from hand_eye_calib.config import CalibratorConfig as CalibratorConfig
from hand_eye_calib.engine.calibrator import Calibrator as Calibrator
from hand_eye_calib.engine.offline import calibrate as calibrate
from hand_eye_calib.engine.offline import cross_check as cross_check
from hand_eye_calib.engine.stops import calibrate_arm as calibrate_arm
from hand_eye_calib.engine.stops import calibrate_stops as calibrate_stops
from hand_eye_calib.errors import HandEyeCalibError as HandEyeCalibError
from hand_eye_calib.geometry.trajectory import Trajectory as Trajectory
from hand_eye_calib.io.results import load as load
from hand_eye_calib.io.results import save as save
from hand_eye_calib.io.stops import read_arm_samples as read_arm_samples
from hand_eye_calib.io.trajectory_files.reading import read_trajectory as read_trajectory
from hand_eye_calib.io.trajectory_files.table import write_trajectory as write_trajectory
from hand_eye_calib.report.figures import plot as plot
from hand_eye_calib.results.calibration import Calibration as Calibration
from hand_eye_calib.results.records import Residuals as Residuals
from hand_eye_calib.results.records import SolveStatus as SolveStatus
from hand_eye_calib.results.verdict import Reason as Reason
from hand_eye_calib.results.verdict import Verdict as Verdict
from hand_eye_calib.session.rig import RigCalibration as RigCalibration
from hand_eye_calib.session.rig import calibrate_rig as calibrate_rig
from hand_eye_calib.session.together import calibrate_many as calibrate_many
from hand_eye_calib.session.together import calibrate_together as calibrate_together
from hand_eye_calib.simulation.drive import simulate as simulate

__version__: str
