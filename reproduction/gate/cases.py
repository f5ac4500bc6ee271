"""Recordings of the gate: simulated ones by seed, real ones with a known answer, and pieces."""

from collections.abc import Container, Iterator
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.geometry.trajectory import Trajectory
from reproduction.coverage import classes, mixed
from reproduction.recordings import Recording, between, real_rigs

# Shortest and longest pieces, as shares of a recording.
_SHARES = (0.2, 0.7)
_FEWEST_POSES = 100


class Case(NamedTuple):
    """A recording with its true extrinsic.

    ``sigmas`` (6,) are the standard deviations of the truth (m, rad) along and about the parent's
    axes. ``bound`` is the Cramer-Rao bound (6, 6) of a simulated recording.
    """

    family: str
    name: str
    streams: tuple[Trajectory, Trajectory]
    options: dict[str, Any]
    T_parent_child: FloatArray
    sigmas: FloatArray
    bound: FloatArray | None = None
    # Whether the verdict USE is wrong, because the motion does not determine all axes.
    must_not_be_used: bool = False


def simulated_case(family: str, seed: int, number: int) -> Case:
    """Draw a recording of a random platform, or of a class of the coverage study."""
    if family in mixed.MIXED:
        drive = mixed.make(family, seed, number)
    else:
        drive = classes.make(family, seed + number)
    return Case(
        family=family,
        name=f"{family} {number}",
        streams=(drive.parent, drive.child),
        options={},
        T_parent_child=drive.T_parent_child,
        sigmas=np.zeros(6),
        bound=drive.bound(),
        must_not_be_used=family in classes.REFUSED,
    )


def simulated_cases(seed: int, repeats: int) -> Iterator[Case]:
    """Yield recordings of random platforms, ``repeats`` of each."""
    for number, family in product(range(repeats), mixed.MIXED):
        yield simulated_case(family, seed, number)


def real_cases(
    folder: Path,
    pieces: int,
    rng: np.random.Generator,
    option_names: Container[str] = ("time_offset",),
) -> Iterator[Case]:
    """Yield real recordings with a known extrinsic, and random pieces of each.

    Only the options in ``option_names`` are used.
    """
    rigs, _ = real_rigs(folder)
    for rig in rigs:
        if rig.truth is None or rig.is_refused or rig.name == "boreas":
            continue
        options = {
            name: value
            for name, value in rig.options.items()
            if name in option_names
        }
        family = rig.name if "kitti" in rig.name else rig.name.split("_")[0]
        for name, recording in rig.recordings.items():
            whole = (recording.parent, recording.child)
            streams_of_cases = [whole, *_pieces(recording, pieces, rng)]
            for number, streams in enumerate(streams_of_cases):
                yield Case(
                    family=family,
                    name=f"{rig.name} {name} {number}",
                    streams=streams,
                    options=options,
                    T_parent_child=rig.truth.T_parent_child,
                    sigmas=rig.truth.sigmas,
                )


def _pieces(
    recording: Recording, count: int, rng: np.random.Generator
) -> Iterator[tuple[Trajectory, Trajectory]]:
    """Yield random pieces of a recording; pieces with too few poses are left out."""
    parent = recording.parent
    child = recording.child
    log_shares = np.log(_SHARES)
    first_ns = max(parent.stamps_ns[0], child.stamps_ns[0])
    last_ns = min(parent.stamps_ns[-1], child.stamps_ns[-1])
    length_ns = last_ns - first_ns
    for _ in range(count):
        share = np.exp(rng.uniform(*log_shares))
        start = rng.uniform(0.0, 1.0 - share)
        start_ns = first_ns + int(start * length_ns)
        end_ns = start_ns + int(share * length_ns)
        parent_piece = between(parent, start_ns, end_ns)
        child_piece = between(child, start_ns, end_ns)
        if min(len(parent_piece), len(child_piece)) >= _FEWEST_POSES:
            yield parent_piece, child_piece
