"""Whole trajectories out of bags."""

from dataclasses import replace

import numpy as np

from hand_eye_calib.errors import InputError
from hand_eye_calib.geometry.trajectory import Trajectory
from hand_eye_calib.io.bags.poses import PoseBlock
from hand_eye_calib.io.bags.reader import PoseBag
from hand_eye_calib.io.bags.topics import Source


def trajectory_of(
    bag: PoseBag, source: Source, measures: str = "auto"
) -> tuple[Trajectory, list[str]]:
    """The trajectory of one source of an open bag.

    Parameters
    ----------
    bag : PoseBag
    source : str or TfSource
    measures : str
        What to read of the poses, see :meth:`PoseBag.measured`.

    Returns
    -------
    Trajectory
        In the order of stamps; of those with equal stamps the first.
    notes : list of str
        What a person should know.

    Raises
    ------
    InputError
        If the bag or a pose cannot be read.
    """
    bag.topics.check(source)
    kind = bag.measured(source, measures)
    notes: list[str] = []
    blocks = list(bag.blocks(source, None, measures={"parent": measures}))
    if not blocks:
        raise InputError(f"no poses on {source} of {bag}")
    poses = PoseBlock.concatenate(blocks)
    trajectory = poses.trajectory()
    if len(trajectory) < len(poses):
        notes.append(
            f"{source}: {len(poses) - len(trajectory)} of {len(poses)} poses had a stamp that was "
            "there already and were dropped"
        )
    if (np.diff(poses.stamps_ns) < 0).any():
        notes.append(f"{source}: stamps were not in the order of the bag and were sorted")
    return replace(trajectory, measures=kind) if kind != "poses" else trajectory, notes
