"""What the adaptive estimator looks at: the increments of Y(i) = T_pw_p(i) X T_cw_c(i)^-1, and where their noise comes from.

Y is the child's world in the parent's world, the same at all times if nothing is wrong. Between consecutive poses i and j = i + 1
its change, written at the sensors and turned into the axes of the parent's world, is

    r_R = Rp_i Log(R_A R R_B' R')                      (rad)
    r_t = (Rp_j - Rp_i) t + p_j - p_i - Rp_i R t_B     (m)

with the parent's pose (Rp, p), the motions A and B, and X = (R, t). To first order in the noise of the poses (rotations Phi_p, Phi_c
and positions n_p, n_c of the two sensors, all turned into the axes of the parent's world)

    r_R = psi_j - psi_i                                          psi = Phi_p - Phi_c
    r_t = Phi_p_j x l_j - Phi_p_i x l_i + (n_p - n_c)_j - (n_p - n_c)_i - psi_i x g_i

with the lever l = Rp t and the step g_i = Rp_i R t_B. Noise that is isotropic at the sensor is isotropic in any axes, so these
residuals are stationary but for the known levers, and their covariance is block tridiagonal.
"""

from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.block_tridiagonal import BLOCK, to_bands
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs

NUISANCES = {"none": 0, "scale": 1, "bias": 3}


@dataclass(frozen=True)
class Linearisation:
    """Residuals, derivatives and noise components at one X.

    Attributes
    ----------
    residuals : (n, 6) array
        (r_R, r_t) of every increment.
    jacobian : (n, 6, 6 + k) array
        Derivatives by xi = (rho, phi) in ``X exp(xi)`` and by the k nuisance parameters.
    components : (4, 12, 6 n) array
        Bands of the covariance for unit variance of: white rotation, white translation, drift of rotation, drift of translation.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    components: np.ndarray

    @property
    def rotation_bands(self):
        """Covariance of one component of r_R: ((2, n) bands for unit white noise, (n,) diagonal for unit drift)."""
        return self.components[0, ::BLOCK, ::BLOCK], self.components[2, 0, ::BLOCK]


class Increments:
    """Increments of two synchronised trajectories.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
    """

    def __init__(self, stamps_ns, Ts_pw_p, Ts_cw_c):
        pairs = motion_pairs(Ts_pw_p, Ts_cw_c, "B1")
        self.rotation_p = Ts_pw_p[:, :3, :3]
        self.steps_p = np.diff(Ts_pw_p[:, :3, 3], axis=0)
        self.rotation_a = pairs.Ts_parenti_parentj[:, :3, :3]
        self.rotation_b = pairs.Ts_childi_childj[:, :3, :3]
        self.translation_b = pairs.Ts_childi_childj[:, :3, 3]
        self.metres_b = np.linalg.norm(self.translation_b, axis=1)
        intervals = np.diff(stamps_ns).astype(float)
        # A random walk's variance grows with time; bounded, so that no gap or twin stamp dominates.
        self.relative_interval = np.clip(intervals / np.median(intervals), 0.1, 100.0)

    def __len__(self):
        return len(self.steps_p)

    def rows(self, selected):
        """Some of the increments; neighbours that were not neighbours before are independent of each other."""
        part = object.__new__(Increments)
        part.rotation_p = self.rotation_p
        part.__dict__.update({name: value[selected] for name, value in self.__dict__.items() if name != "rotation_p"})
        part.selected = selected
        return part

    @property
    def first_pose(self):
        """(n,) indices of the pose each increment starts from."""
        return getattr(self, "selected", np.arange(len(self)))

    def corrected_steps(self, nuisance, parameters):
        """The child's translations (n, 3) with a scale error or a bias per metre taken out."""
        if nuisance == "scale":
            return self.translation_b * (1.0 + parameters[0])
        if nuisance == "bias":
            return self.translation_b - parameters * self.metres_b[:, None]
        return self.translation_b

    def residuals(self, T_parent_child, nuisance="none", parameters=()):
        """(n, 6) array: (r_R, r_t), see the module."""
        rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
        rotation_i, rotation_j = self.rotation_p[self.first_pose], self.rotation_p[self.first_pose + 1]
        steps = (rotation_i @ rotation @ self.corrected_steps(nuisance, parameters)[:, :, None])[:, :, 0]
        mismatch = self.rotation_a @ rotation @ np.swapaxes(self.rotation_b, 1, 2) @ rotation.T
        residual_r = (rotation_i @ se3.rotation_log(mismatch)[:, :, None])[:, :, 0]
        residual_t = (rotation_j - rotation_i) @ translation + self.steps_p - steps
        return np.concatenate([residual_r, residual_t], axis=1)

    def jacobian(self, T_parent_child, nuisance="none", parameters=()):
        """(n, 6, 6 + k) array, see :class:`Linearisation`."""
        rotation = T_parent_child[:3, :3]
        rotation_i, rotation_j = self.rotation_p[self.first_pose], self.rotation_p[self.first_pose + 1]
        turned = (rotation_j - rotation_i) @ rotation
        into_world = rotation_i @ rotation
        jacobian = np.zeros((len(self), 6, 6 + NUISANCES[nuisance]))
        jacobian[:, :3, 3:6] = turned
        jacobian[:, 3:, :3] = turned
        jacobian[:, 3:, 3:6] = into_world @ se3.skew(self.corrected_steps(nuisance, parameters))
        if nuisance == "scale":
            jacobian[:, 3:, 6] = -(into_world @ self.translation_b[:, :, None])[:, :, 0]
        elif nuisance == "bias":
            jacobian[:, 3:, 6:] = into_world * self.metres_b[:, None, None]
        return jacobian

    def components(self, T_parent_child, nuisance="none", parameters=()):
        """(4, 12, 6 n) array, see :class:`Linearisation`.

        The white rotation noise is split evenly between the sensors; only the parent's half has the lever l, which decides how it
        enters the translation residual.
        """
        n_rows = len(self)
        rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
        rotation_i, rotation_j = self.rotation_p[self.first_pose], self.rotation_p[self.first_pose + 1]
        step = se3.skew((rotation_i @ rotation @ self.corrected_steps(nuisance, parameters)[:, :, None])[:, :, 0])
        lever_i, lever_j = se3.skew(rotation_i @ translation), se3.skew(rotation_j @ translation)
        eye, zero = np.broadcast_to(np.eye(3), (n_rows, 3, 3)), np.zeros((n_rows, 3, 3))
        half = np.sqrt(0.5)
        # How noise of pose i and of pose j enters an increment: (rotation rows, translation rows) for each source.
        parent_i, parent_j = half * _stack(-eye, lever_i + step), half * _stack(eye, -lever_j)
        child_i, child_j = half * _stack(eye, -step), half * _stack(-eye, zero)
        position_i, position_j = _stack(zero, -eye), _stack(zero, eye)
        adjacent = np.diff(self.first_pose) == 1
        drift = np.zeros((2, n_rows, 6, 6))
        drift[0, :, range(3), range(3)] = drift[1, :, range(3, 6), range(3, 6)] = self.relative_interval
        nothing = np.zeros((n_rows - 1, 6, 6))
        return np.stack(
            [
                _white([parent_i, child_i], [parent_j, child_j], adjacent),
                _white([position_i], [position_j], adjacent),
                to_bands(drift[0], nothing),
                to_bands(drift[1], nothing),
            ]
        )

    def linearise(self, T_parent_child, nuisance="none", parameters=()):
        """All three at one X."""
        arguments = (T_parent_child, nuisance, parameters)
        return Linearisation(self.residuals(*arguments), self.jacobian(*arguments), self.components(*arguments))


def _stack(upper, lower):
    return np.concatenate([upper, lower], axis=1)


def _white(at_i, at_j, adjacent):
    """Bands of the covariance of increments whose poses carry independent noise of unit variance from each source."""
    diagonal = sum(block @ np.swapaxes(block, 1, 2) for block in (*at_i, *at_j))
    # Increments k - 1 and k share pose k: the first ends there, the second starts there.
    below = sum(start[1:] @ np.swapaxes(end[:-1], 1, 2) for start, end in zip(at_i, at_j, strict=True))
    return to_bands(diagonal, below * adjacent[:, None, None])
