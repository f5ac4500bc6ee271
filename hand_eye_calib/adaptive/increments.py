"""What the adaptive estimator looks at: the increments of Y(i) = T_pw_p(i) X T_cw_c(i)^-1, and
where their noise comes from.

Y is the child's world in the parent's world, the same at all times if nothing is wrong. Between
consecutive poses i and j = i + 1 its change, written at the sensors and turned into the axes of the
parent's world, is

    r_R = Rp_i Log(R_A R R_B' R')                      (rad)
    r_t = (Rp_j - Rp_i) t + p_j - p_i - Rp_i R t_B     (m)

with the parent's pose (Rp, p), the motions A and B, and X = (R, t). To first order in the noise of
the poses (rotations Phi_p, Phi_c and positions n_p, n_c of the two sensors, all turned into the
axes of the parent's world)

    r_R = psi_j - psi_i                                          psi = Phi_p - Phi_c
    r_t = Phi_p_j x l_j - Phi_p_i x l_i + (n_p - n_c)_j - (n_p - n_c)_i - psi_i x g_i

with the lever l = Rp t and the step g_i = Rp_i R t_B. Noise that is isotropic at the sensor is
isotropic in any axes, so these residuals are stationary but for the known levers, and their
covariance is block tridiagonal.

Odometry is wrong about the sensor's own place. A camera that sees a target is not: it is right
about where the target is, and where it is wrong about the target's rotation, its own place swings
about the target. Its position error then contains Phi x d, d being the way from the origin of its
world to the sensor.
"""

import copy
from dataclasses import dataclass

import numpy as np

from hand_eye_calib.adaptive.block_tridiagonal import cut_below, to_bands
from hand_eye_calib.geometry import se3
from hand_eye_calib.pairing.motion_pairs import motion_pairs

# Systematic errors, and which parameters are theirs: by how much the child's lengths are short,
# bias per metre of the child's or of the parent's path along the axes of that sensor (m/m), by how
# much the child's stamps are late (s).
_SYSTEMATIC = {"none": [], "scale": [0], "bias": [1, 2, 3], "parent bias": [4, 5, 6], "time": [7]}
NUISANCES = (
    "none",
    "scale",
    "bias",
    "parent bias",
    "time",
    "scale+time",
    "bias+time",
    "parent bias+time",
)
ALL_SYSTEMATIC = "scale+bias+parent bias+time"
_N_SYSTEMATIC = 8

# What white rotation noise turns a trajectory about: either sensor itself, or the origin of the
# child's or of the parent's world.
CENTRES = ("sensors", "child", "parent")


def nuisance_columns(nuisance):
    """Which of the parameters of all systematic errors are those of a model."""
    return [index for name in nuisance.split("+") for index in _SYSTEMATIC[name]]


def nuisance_values(nuisance, parameters):
    """Scale error, biases per metre of child and parent (2, 3) and lateness of the stamps (s); zero
    where the model has none.
    """
    values = np.zeros(_N_SYSTEMATIC)
    values[nuisance_columns(nuisance)] = parameters
    return values[0], values[1:7].reshape(2, 3), values[7]


@dataclass(frozen=True)
class Components:
    """Where the covariance of the residuals comes from: white rotation, white translation, drift of
    rotation, drift of translation.

    Attributes
    ----------
    white_rotation : (n, 6, 12) array
        Bands of the covariance for unit variance of white rotation noise.
    joined : (n - 1,) array
        1 where an increment starts at the pose at which the one before it ends, 0 elsewhere.
    relative_interval : (n,) array
        Variance of the drift over each increment for unit variance over a typical one.
    """

    white_rotation: np.ndarray
    joined: np.ndarray
    relative_interval: np.ndarray

    def covariance(self, variances):
        """Bands (n, 6, 12) of the covariance for variances (4,) of the four."""
        white_r, white_t, drift_r, drift_t = variances
        bands = white_r * self.white_rotation
        bands[:, :3, 0] += drift_r * self.relative_interval[:, None]
        bands[:, 3:, 0] += 2.0 * white_t + drift_t * self.relative_interval[:, None]
        bands[:-1, 3:, 6] -= white_t * self.joined[:, None]
        return bands

    def rows(self, selected):
        """Those of some increments, in order; neighbours that were not neighbours before are
        independent of each other.
        """
        apart = np.flatnonzero(np.diff(selected) != 1)
        white_rotation, joined = self.white_rotation[selected], self.joined[selected[:-1]]
        cut_below(white_rotation, apart)
        joined[apart] = 0.0
        return Components(white_rotation, joined, self.relative_interval[selected])


@dataclass(frozen=True)
class Linearisation:
    """Residuals, derivatives and noise components at one X.

    Attributes
    ----------
    residuals : (n, 6) array
        (r_R, r_t) of every increment.
    jacobian : (n, 6, 6 + k) array
        Derivatives by xi = (rho, phi) in ``X exp(xi)`` and by the k nuisance parameters.
    components : Components
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    components: Components

    def rows(self, selected):
        """That of some increments, in order."""
        return Linearisation(
            self.residuals[selected], self.jacobian[selected], self.components.rows(selected)
        )


class Increments:
    """Increments of two synchronised trajectories.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    Ts_pw_p, Ts_cw_c : (N, 4, 4) arrays
    centre : {"sensors", "child", "parent"}
        What white rotation noise turns the trajectories about, see ``CENTRES``.
    typical_ns : float, optional
        Interval in which drift has unit variance; the median one by default.
    """

    def __init__(self, stamps_ns, Ts_pw_p, Ts_cw_c, centre="sensors", typical_ns=None):
        pairs = motion_pairs(Ts_pw_p, Ts_cw_c, "B1")
        intervals = np.diff(stamps_ns).astype(float)
        self.centre = centre
        self.rotation_i, self.rotation_j = Ts_pw_p[:-1, :3, :3], Ts_pw_p[1:, :3, :3]
        self.steps_p = np.diff(Ts_pw_p[:, :3, 3], axis=0)
        self.rotation_a = pairs.Ts_parenti_parentj[:, :3, :3]
        self.rotation_b = pairs.Ts_childi_childj[:, :3, :3]
        self.translation_b = pairs.Ts_childi_childj[:, :3, 3]
        self.metres_a = np.linalg.norm(self.steps_p, axis=1)
        self.metres_b = np.linalg.norm(self.translation_b, axis=1)
        self.per_second_r, self.per_second_t = _per_second_later(
            pairs.Ts_childi_childj, intervals * 1e-9
        )
        # Ways from the origins of their worlds to the sensors, in the axes of the parent's world
        # and of the child.
        self.from_origin_p, self.from_origin_c = (
            Ts_pw_p[:-1, :3, 3],
            -se3.inverse(Ts_cw_c[:-1])[:, :3, 3],
        )
        # A random walk's variance grows with time; bounded, so that no gap or twin stamp dominates.
        self.relative_interval = np.clip(
            intervals / (typical_ns or np.median(intervals)), 0.1, 100.0
        )

    def __len__(self):
        return len(self.relative_interval)

    def about(self, centre):
        """The same increments with their rotation noise about another centre."""
        other = copy.copy(self)
        other.centre = centre
        return other

    def _corrected(self, nuisance, parameters):
        """The child's motions with systematic errors taken out: rotations (n, 3, 3) and
        translations (n, 3).
        """
        scale, (bias, _), offset_s = nuisance_values(nuisance, parameters)
        rotation_b = (
            self.rotation_b @ se3.rotation_exp(offset_s * self.per_second_r)
            if offset_s
            else self.rotation_b
        )
        translation_b = (1.0 + scale) * (self.translation_b + offset_s * self.per_second_t)
        return rotation_b, translation_b - bias * self.metres_b[:, None]

    def residuals(self, T_parent_child, nuisance="none", parameters=()):
        """(n, 6) array: (r_R, r_t), see the module."""
        rotation = T_parent_child[:3, :3]
        rotation_b, translation_b = self._corrected(nuisance, parameters)
        mismatch = self.rotation_a @ rotation @ np.swapaxes(rotation_b, 1, 2) @ rotation.T
        residual_r = _turned(self.rotation_i, se3.rotation_log(mismatch))
        residual_t = self._steps_by_parent(T_parent_child) - _turned(
            self.rotation_i @ rotation, translation_b
        )
        _, (_, bias), _ = nuisance_values(nuisance, parameters)
        residual_t -= self.rotation_i @ bias * self.metres_a[:, None]
        return np.concatenate([residual_r, residual_t], axis=1)

    def seen_from_centre(self, T_parent_child):
        """Residuals (n, 6) at the point that white rotation noise leaves in place: r_t is then that
        of translation noise alone.
        """
        residuals = self.residuals(T_parent_child)
        if self.centre == "child":
            way = _turned(self.rotation_i @ T_parent_child[:3, :3], self.from_origin_c)
        elif self.centre == "parent":
            way = self.from_origin_p + self.rotation_i @ T_parent_child[:3, 3]
        else:
            return residuals
        residuals[:, 3:] -= np.cross(residuals[:, :3], way)
        return residuals

    def _steps_by_parent(self, T_parent_child):
        """The child's steps (n, 3), in the axes of the parent's world, as the parent's motion has
        them.
        """
        return (self.rotation_j - self.rotation_i) @ T_parent_child[:3, 3] + self.steps_p

    def jacobian(self, T_parent_child, nuisance="none", parameters=()):
        """(n, 6, 6 + k) array, see :class:`Linearisation`."""
        rotation = T_parent_child[:3, :3]
        turned = (self.rotation_j - self.rotation_i) @ rotation
        into_world = self.rotation_i @ rotation
        rotation_b, translation_b = self._corrected(nuisance, parameters)
        columns = nuisance_columns(nuisance)
        jacobian = np.zeros((len(self), 6, 6 + len(columns)))
        jacobian[:, :3, 3:6] = turned
        jacobian[:, 3:, :3] = turned
        jacobian[:, 3:, 3:6] = into_world @ se3.skew(translation_b)
        if columns:
            scale, _, offset_s = nuisance_values(nuisance, parameters)
            systematic = np.zeros((len(self), 6, _N_SYSTEMATIC))
            systematic[:, 3:, 0] = -self._fair_steps(T_parent_child, scale, offset_s)
            systematic[:, 3:, 1:4] = into_world * self.metres_b[:, None, None]
            systematic[:, 3:, 4:7] = -self.rotation_i * self.metres_a[:, None, None]
            systematic[:, :3, 7] = -_turned(into_world @ rotation_b, self.per_second_r)
            systematic[:, 3:, 7] = -(1.0 + scale) * _turned(into_world, self.per_second_t)
            jacobian[:, :, 6:] = systematic[:, :, columns]
        return jacobian

    def _fair_steps(self, T_parent_child, scale, offset_s):
        """The child's steps (n, 3) in its own unit and the axes of the parent's world, for the
        derivative by scale.

        Taken from the child alone, they would be correlated with the residuals through its noise,
        and a child whose steps drown in noise would seem to be shrinking. The mean of what both
        sensors say is not, where both are as noisy.
        """
        by_parent = self._steps_by_parent(T_parent_child) / (1.0 + scale)
        by_child = _turned(
            self.rotation_i @ T_parent_child[:3, :3],
            self.translation_b + offset_s * self.per_second_t,
        )
        return {"sensors": 0.5 * (by_parent + by_child), "child": by_parent, "parent": by_child}[
            self.centre
        ]

    def components(self, T_parent_child, nuisance="none", parameters=()):
        """Components at one X.

        White rotation noise about the sensors is split evenly between them, that about the origin
        of a world is its sensor's; this decides how it enters the translation residual: psi_i as
        (-1, p x), psi_j as (1, -q x), in rows of rotation and of translation.
        """
        rotation, translation = T_parent_child[:3, :3], T_parent_child[:3, 3]
        step = _turned(self.rotation_i @ rotation, self._corrected(nuisance, parameters)[1])
        # Ways to the child from what each source's noise turns about, at i (with the step that is
        # still ahead) and at j.
        if self.centre == "child":
            from_origin = _turned(self.rotation_i @ rotation, self.from_origin_c) + step
            sources = [(1.0, from_origin, from_origin)]
        else:
            parent_i, parent_j = self.rotation_i @ translation + step, self.rotation_j @ translation
            if self.centre == "parent":
                sources = [
                    (
                        1.0,
                        parent_i + self.from_origin_p,
                        parent_j + self.from_origin_p + self.steps_p,
                    )
                ]
            else:
                sources = [(0.5, parent_i, parent_j), (0.5, step, np.zeros_like(step))]
        diagonal, below = np.zeros((len(self), 6, 6)), np.zeros((len(self) - 1, 6, 6))
        for share, p, q in sources:
            skew_p, skew_q = np.sqrt(share) * se3.skew(p), np.sqrt(share) * se3.skew(q)
            diagonal[:, 3:, 3:] -= skew_p @ skew_p + skew_q @ skew_q
            diagonal[:, 3:, :3] -= np.sqrt(share) * (skew_p + skew_q)
            # Increments k - 1 and k share pose k: the first ends there, the second starts there.
            below[:, 3:, 3:] += skew_p[1:] @ skew_q[:-1]
            below[:, 3:, :3] += np.sqrt(share) * skew_p[1:]
            below[:, :3, 3:] -= np.sqrt(share) * skew_q[:-1]
        diagonal[:, range(3), range(3)], below[:, range(3), range(3)] = 2.0, -1.0
        return Components(to_bands(diagonal, below), np.ones(len(self) - 1), self.relative_interval)

    def linearise(self, T_parent_child, nuisance="none", parameters=()):
        """All three at one X."""
        arguments = (T_parent_child, nuisance, parameters)
        return Linearisation(
            self.residuals(*arguments), self.jacobian(*arguments), self.components(*arguments)
        )


def _per_second_later(Ts_childi_childj, intervals_s):
    """Change of motions per second by which both their ends are taken later: rotation vectors (n,
    3) in axes j, translations (n, 3).

    The velocity at a pose is the mean of the middle two of the four increments around it, component
    by component: jumps are no velocity.
    """
    velocities = se3.log(Ts_childi_childj) / np.maximum(intervals_s, 1e-9)[:, None]
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(velocities, ((2, 2), (0, 0)), mode="edge"), 4, axis=0
    )
    velocities = np.sort(around, axis=2)[:, :, 1:3].mean(axis=2)
    (at_i, at_j), rotation = (velocities[:-1], velocities[1:]), Ts_childi_childj[:, :3, :3]
    per_second_r = at_j[:, 3:] - _turned(np.swapaxes(rotation, 1, 2), at_i[:, 3:])
    per_second_t = (
        _turned(rotation, at_j[:, :3])
        - at_i[:, :3]
        - np.cross(at_i[:, 3:], Ts_childi_childj[:, :3, 3])
    )
    return per_second_r, per_second_t


def _turned(rotations, vectors):
    return (rotations @ vectors[:, :, None])[:, :, 0]
