"""Comparison of two readings of the same poses by the likelihood of their noise.

A *reading* interprets both streams as poses of the sensors, or both as inverse poses. If all poses
are inverted, A Y = Y B holds for the pose Y of one world in the other world, with equally small
residuals. So residuals cannot decide between two readings, but the noise can. In the right reading,
drift accumulates in the frame of the sensor, and rotation errors turn about the sensor, or about
the target of a camera. In the wrong reading, the same errors grow with the distance from the origin
of a world.

The losses of two readings are comparable under these conditions:

- The data are motions, not poses. An inversion of the poses changes the motions by an adjoint of
  determinant 1, so the probability densities of both readings have the same unit.
- Both readings ignore the same jumps and outlier poses, and have no robust weights.
- Both readings have the same parameters, with the same prior standard deviations.
- Each reading has its own best centre of rotation noise: a camera that observes a target has the
  white noise of the inverse poses of a tracker.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray, IntArray
from hand_eye_calib.core.noise import stages
from hand_eye_calib.core.noise.fit import Fit, Problem, Workspace
from hand_eye_calib.core.noise.increments import (
    SYSTEMATIC,
    Streams,
    parameter_columns,
)
from hand_eye_calib.core.noise.noise_model import CENTRES
from hand_eye_calib.core.noise.outliers import Outliers, bridge_outliers

# Largest number of poses that are used, evenly spread. Measured: the search takes about 1 ms per
# pose and reading.
_MAX_POSES = 1500


def loss_difference(
    stamps_ns: IntArray,
    first: tuple[FloatArray, FloatArray],
    second: tuple[FloatArray, FloatArray],
) -> float:
    """Return the loss of the second reading minus the loss of the first reading.

    The loss of a reading is the restricted negative log likelihood of its noise.

    Parameters
    ----------
    stamps_ns : (N,) int64 array
    first, second : tuples of two (N, 4, 4) arrays
        Readings: poses of parent and child at these stamps, in the same unit of length.

    Returns
    -------
    float
        Negative if the noise model explains the second reading better.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the noise model cannot be fitted to a reading.
    """
    # The quotient is rounded up.
    stride = -(-len(stamps_ns) // _MAX_POSES)
    stamps_s = (stamps_ns - stamps_ns[0]) * 1e-9
    workspaces = []
    fits = []
    for Ts_pw_p, Ts_cw_c in (first, second):
        streams = Streams(stamps_s, Ts_pw_p, Ts_cw_c)[::stride]
        problem = Problem(streams, parameter_columns(SYSTEMATIC))
        workspace = Workspace(problem)
        fit = stages.noise(workspace, stages.start(problem))
        fits.append(stages.outliers(workspace, fit))
        workspaces.append(workspace)
    outliers_of_both = Outliers(
        fits[0].outliers.jumps | fits[1].outliers.jumps,
        fits[0].outliers.spikes | fits[1].outliers.spikes,
    )
    losses = []
    for workspace, fit in zip(workspaces, fits, strict=True):
        losses.append(_smallest_loss(workspace, fit, outliers_of_both))
    return losses[1] - losses[0]


def _smallest_loss(
    workspace: Workspace, start: Fit, outliers: Outliers
) -> float:
    """Return the smallest loss of a reading over all centres of white rotation errors.

    ``start`` is a fit of this reading. The search ignores the poses and increments in ``outliers``,
    and uses no robust weights.
    """
    streams = workspace.problem.streams
    n_poses = len(streams)
    plain = replace(
        start,
        poses=bridge_outliers(streams, start.T, outliers.spikes),
        error=np.zeros((n_poses, 6)),
        outliers=outliers,
        weights=np.ones(n_poses),
        has_heavy_tails=False,
    )
    fits = []
    for centre in CENTRES:
        model = replace(start.model, processes=(), centre=centre)
        with suppress(np.linalg.LinAlgError):
            fits.append(stages.noise(workspace, replace(plain, model=model)))
    if not fits:
        raise np.linalg.LinAlgError("no noise model fits these poses")
    best = min(fits, key=lambda fit: _loss(workspace, fit))
    best = stages.time_correlated(workspace, best)
    return min(
        _loss(workspace, best), _loss(workspace, stages.polish(workspace, best))
    )


def _loss(workspace: Workspace, fit: Fit) -> float:
    """Return the restricted negative log likelihood with the constant term of the prior."""
    prior_sigmas = fit.sigmas[workspace.problem.columns]
    return workspace.posterior(fit).loss + float(np.log(prior_sigmas).sum())
