"""What estimates the extrinsic, or a part of it, by what both streams measure together."""

from collections.abc import Callable, Mapping
from typing import TypeAlias

from hand_eye_calib.config import CalibratorConfig
from hand_eye_calib.engine.estimation import estimate_extrinsic
from hand_eye_calib.engine.lever_arms import estimate_lever_arm
from hand_eye_calib.engine.rotations import estimate_rotation
from hand_eye_calib.pairing.synchronise import PosePairs
from hand_eye_calib.results.calibration import Calibration

Estimator: TypeAlias = Callable[[PosePairs, CalibratorConfig], Calibration]

ESTIMATORS: Mapping[str, Estimator] = {
    "poses": estimate_extrinsic,
    "rotations": estimate_rotation,
    "positions": estimate_lever_arm,
}
