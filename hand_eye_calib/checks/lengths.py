"""Whether the lengths of the parent, which give the result its unit, can be in metres: two streams
in millimetres agree, and nothing else tells.
"""

import numpy as np

from hand_eye_calib.checks import findings as wording
from hand_eye_calib.checks.findings import Finding
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.stats import quantile

# No vehicle that calibrates its sensors by motion goes faster than sound (m/s), or bears ten times
# gravity for a whole second (m/s^2), which is twice what a racing car does. Arms, which move least,
# have 0.1 m/s^2 in metres and so exceed that in millimetres.
_FASTEST, _HARDEST = 340.0, 98.0

# Velocities are over so long (s), so that noise adds little. A tenth of them may be of jumps.
_STEP_S, _USUAL = 1.0, 0.9


def check_lengths(parent: Trajectory) -> list[Finding]:
    """Finding about motion that no vehicle has, or none."""
    steps = (parent.stamps_ns - parent.stamps_ns[0]) // round(_STEP_S * 1e9)
    rows = np.unique(steps, return_index=True)[1]
    if len(rows) < 4:
        return []
    intervals_s = np.diff(parent.stamps_ns[rows])[:, None] * 1e-9
    velocities = np.diff(parent.poses[rows, :3, 3], axis=0) / intervals_s
    changes = np.diff(velocities, axis=0) / (0.5 * (intervals_s[1:] + intervals_s[:-1]))
    speed = quantile(np.linalg.norm(velocities, axis=1), _USUAL)
    change = quantile(np.linalg.norm(changes, axis=1), _USUAL)
    if speed < _FASTEST and change < _HARDEST:
        return []
    return [wording.finding("lengths", "parent", speed_m_s=speed, acceleration_m_s2=change)]
