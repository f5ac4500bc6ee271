"""Comparison of two readings of the same poses by the likelihood of their noise.

If every pose of both streams is inverted, the streams agree just as well: A Y = Y B then holds for
the pose Y of one world in the other. Residuals cannot decide between these two readings, but the
noise can. In the right reading, drift accumulates in the sensor frame, and rotation errors turn
about the sensor, or about the target of a camera. In the wrong reading, the same errors grow with
the distance from the origin of a world.

The losses of two readings are comparable under these conditions:

- The data are motions, not poses. Inverting the poses transforms the motions by an adjoint of
  determinant 1, so the probability densities of both readings have the same unit.
- Both readings skip the same jumps and outlier poses, and have no robust weights.
- Both readings have the same parameters with the same prior standard deviations.
- Each reading has its best centre of rotation noise: a camera that observes a target has the same
  white noise as the inverted poses of a tracker.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.noise import stages
from hand_eye_calib.core.noise.increments import PARAMETERS, SYSTEMATIC, Streams
from hand_eye_calib.core.noise.noise_model import CENTRES
from hand_eye_calib.core.noise.outliers import Outliers, bridged

# Largest number of poses to compare, evenly spread. The search takes about 1 ms for each pose and
# reading.
MOST_POSES = 1500


def loss_difference(
    stamps_ns: IntArray,
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
) -> float:
    """Return the restricted negative log likelihood of the second reading less that of the first.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    first, second : tuples of two (N, 4, 4) arrays
        Poses of parent and child at these stamps, in one unit of length.

    Returns
    -------
    float
        Negative if the noise model explains the second reading better.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the noise model cannot be fitted to a reading.
    """
    stride = -(-len(stamps_ns) // MOST_POSES)
    workspaces = []
    for Ts_pw_p, Ts_cw_c in (first, second):
        stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
        streams = Streams(stamps_s, Ts_pw_p, Ts_cw_c)[::stride]
        columns = [column for name in SYSTEMATIC for column in PARAMETERS[name]]
        workspaces.append(stages.Workspace(stages.Problem(streams, columns)))
    starts = []
    for workspace in workspaces:
        noise = stages.noise(workspace, stages.start(workspace.problem))
        starts.append(stages.outliers(workspace, noise))
    common = Outliers(
        starts[0].outliers.jumps | starts[1].outliers.jumps,
        starts[0].outliers.spikes | starts[1].outliers.spikes,
    )
    losses = []
    for workspace, start in zip(workspaces, starts, strict=True):
        losses.append(_least_loss(workspace, start, common))
    return losses[1] - losses[0]


def _least_loss(workspace: stages.Workspace, start: stages.Fit, outliers: Outliers) -> float:
    """Return the smallest loss of a reading over all centres of rotation noise.

    The fit has the given outliers and no robust weights.
    """
    streams = workspace.problem.streams
    n_poses = len(streams)
    fits = []
    for centre in CENTRES:
        plain = replace(
            start,
            poses=bridged(streams, start.T, outliers.spikes),
            error=np.zeros((n_poses, 6)),
            model=replace(start.model, slow=(), centre=centre),
            outliers=outliers,
            weights=np.ones(n_poses),
            has_heavy_tails=False,
        )
        with suppress(np.linalg.LinAlgError):
            fits.append(stages.noise(workspace, plain))
    if not fits:
        raise np.linalg.LinAlgError("no noise model fits these poses")
    best = min(fits, key=lambda fit: _loss(workspace, fit))
    best = stages.lasting(workspace, best)
    return min(_loss(workspace, best), _loss(workspace, stages.polish(workspace, best)))


def _loss(workspace: stages.Workspace, fit: stages.Fit) -> float:
    """Return the restricted negative log likelihood, with the normalisation of the prior."""
    prior_sigmas = fit.sigmas[workspace.problem.columns]
    return workspace.posterior(fit).loss + float(np.log(prior_sigmas).sum())
