"""Motions of a sensor in the windows of a drive, and the motions that the wheels predict."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.vehicle.wheels import WheelModel, motions

# Indices of some of the U unknowns. Unknowns 0 to 4 are the pose of the sensor: x, y (m), and
# rotations about the axes x, y, z of the axle (rad). Then follow the clock offset (s), the slip
# angle per lateral acceleration (rad s^2/m), and the parameters of the wheels.
Y = 1

TILT = (2, 3)

YAW = 4

CLOCK = 5

# Step of numerical derivatives, in the unit of each unknown.
STEP = 1e-6


@dataclass(frozen=True)
class Drive:
    """Motions of a sensor in K windows, and the wheel data.

    Attributes
    ----------
    xi : (K, 6) array
        Logarithms (rho, phi) of the motions, in the frame of the sensor.
    ends_s : (2, K) array
        Times of the start and the end of each window.
    stamps_s : (N + 1,) array
        Times of the wheel data.
    steps : (3, N) array
        Steps of the unit vehicle between these times, see :mod:`.wheels`.
    model : WheelModel or None
        Model of the wheels; None without wheels.
    components : sequence of int
        Indices of the C compared components of e (of six).
    """

    xi: FloatArray
    ends_s: FloatArray
    stamps_s: FloatArray
    steps: FloatArray
    model: WheelModel | None
    components: Sequence[int]

    def motions_of_unit_vehicle(self) -> FloatArray:
        """Return the sums (3, K) of the steps in each window: forward, left and turn."""
        totals = np.insert(np.cumsum(self.steps, axis=1), 0, 0.0, axis=1)
        at_ends = np.array(
            [np.interp(self.ends_s, self.stamps_s, total) for total in totals]
        )
        return at_ends[:, 1] - at_ends[:, 0]

    def measured(self, T: FloatArray) -> FloatArray:
        """Return the motions (K, 6) of the axle according to the sensor, for its pose T (4, 4)."""
        return self.xi @ se3.adjoint(T).T

    def predicted(self, T: FloatArray, others: FloatArray) -> FloatArray:
        """Return the motions (K, 6) of the axle according to the wheels.

        Without wheels, only the side slip is predicted, from the motion of the sensor at the pose
        T. ``others`` are all unknowns except the pose.
        """
        clock_s, slip = others[:2]
        # Over a length l with the speed v and the turn a, the slip angle is slip * v a / t with the
        # duration t = l / v. So the axle slips to the side by l * slip * v a / t = slip * v^2 a.
        predicted = np.zeros(self.xi.shape)
        if self.model is None:
            axle = self.measured(T)
            speeds = axle[:, 0] / (self.ends_s[1] - self.ends_s[0])
            predicted[:, 1] = -slip * speeds**2 * axle[:, 5]
            return predicted
        forward, left, turns = self.model.steps_of(others[2:], *self.steps)
        speeds = forward / np.diff(self.stamps_s)
        steps = np.stack([forward, left - slip * speeds**2 * turns, turns])
        in_plane = motions(self.stamps_s, steps, self.ends_s + clock_s)
        predicted[:, [0, 1, 5]] = in_plane.T
        return predicted

    def rows(self, T: FloatArray, others: FloatArray) -> FloatArray:
        """Return the linear equations (K, C, U + 1) of a step of the U unknowns.

        The columns are the derivatives of e with respect to the unknowns, and -e.
        """
        predicted = self.predicted(T, others)
        residuals = predicted - self.measured(T)
        columns = []
        for index, step in enumerate(STEP * np.eye(CLOCK + len(others))):
            new_T, new_others = apply_step(T, others, step)
            # The prediction by the wheels does not depend on the pose.
            if self.model is None or index >= CLOCK:
                predicted = self.predicted(new_T, new_others)
            columns.append(
                (predicted - self.measured(new_T) - residuals) / STEP
            )
        return np.stack([*columns, -residuals], axis=-1)[:, self.components]


def apply_step(
    T: FloatArray, others: FloatArray, step: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the pose and the other unknowns after a step (U,)."""
    rotation = se3.rotation_exp(step[Y + 1 : CLOCK]) @ se3.rotation_of(T)
    translation = se3.translation_of(T) + np.append(step[: Y + 1], 0.0)
    new_T = se3.from_rotation_translation(rotation, translation)
    return new_T, others + step[CLOCK:]
