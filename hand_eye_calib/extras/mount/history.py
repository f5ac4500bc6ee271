"""History of a mount from the digests of its sessions, with the changes in it.

The offset of the child from the installed pose in session k is d + u_k, with the common-mode error
u_k ~ N(0, W). The evidence [H_k S_k] of the session measures this offset. From session c on, after
a change, the offset is d + s + u_k.

The change is the c with the largest likelihood ratio of a shift s against none, as in the monitor
(:mod:`hand_eye_calib.extras.mount.monitor`). The sessions before and after a change are searched
again (binary segmentation: A. Scott, M. Knott, *A cluster analysis method*, 1974).
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hand_eye_calib.core.assessment import change, moved
from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.blocks import Blocks, information, inverse, score, shift_evidence
from hand_eye_calib.core.base.errors import ConfigError
from hand_eye_calib.core.base.plain import plain
from hand_eye_calib.core.base.text import amount, counted
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.mount.digest import Digest, read_digests
from hand_eye_calib.extras.mount.monitor import KNOCKS, TUNING
from hand_eye_calib.offline.cli.options import print_result
from hand_eye_calib.online.live.progress import AXIS_KEYS

# Covariance of an unknown offset.
_UNKNOWN = np.diag(change.UNKNOWN**2)


@dataclass(frozen=True)
class Changepoint:
    """A change of the mount.

    Attributes
    ----------
    index : int
        First session after the change.
    log_ratio : float
    shift : Moved
        Along and about the axes of the parent sensor's frame.
    """

    index: int
    log_ratio: float
    shift: change.Moved


def find_changes(digests: Sequence[Digest]) -> list[Changepoint]:
    """Return the changes of the mount between sessions, the earliest first.

    A change at the first session is one from the installed pose.
    """
    if not digests:
        return []
    tables = np.array([_with_wander(digest) for digest in digests])
    to_parent = se3.block_diagonal(se3.rotation_of(digests[0].installed))
    found = _changes(tables, 0, digests[0].covariance, to_parent, cuts_from=0)
    return sorted(found, key=lambda changepoint: changepoint.index)


def _with_wander(digest: Digest) -> FloatArray:
    """Return the evidence (6, 7) of a session on the offset that all sessions share."""
    return shift_evidence(digest.evidence, np.zeros(6), digest.wander)


def _changes(
    tables: FloatArray, start: int, prior: FloatArray, to_parent: FloatArray, cuts_from: int
) -> Iterator[Changepoint]:
    """Yield the changes within sessions.

    Parameters
    ----------
    tables : (n, 6, 7) array
        Evidence of each session.
    start : int
        Index of the first session.
    prior : (6, 6) array
        Covariance of the offset before the sessions.
    to_parent : (6, 6) array
        Rotation of tangent vectors from the child's to the parent's frame.
    cuts_from : int
        First session that may follow a change.
    """
    cuts = np.arange(cuts_from, len(tables))
    if not len(cuts):
        return
    blocks = Blocks(tables)
    after = blocks.since(cuts)
    before = blocks.total - after
    covariances = inverse(inverse(prior) + information(before))
    offsets = se3.times(covariances, score(before))
    shifts = shift_evidence(after, offsets, covariances)
    ratios = moved.log_ratio(shifts, KNOCKS[:, None]).max(axis=0)
    best = int(np.argmax(ratios))
    if ratios[best] < TUNING.threshold:
        return
    cut = int(cuts[best])
    yield Changepoint(start + cut, float(ratios[best]), _shift_of(shifts[best], to_parent))
    yield from _changes(tables[:cut], start, prior, to_parent, cuts_from)
    yield from _changes(tables[cut:], start + cut, _UNKNOWN, to_parent, cuts_from=1)


def _shift_of(table: FloatArray, to_parent: FloatArray) -> change.Moved:
    """Return a shift from its evidence."""
    prior = inverse(moved.shift_covariance(1.0, 1.0))
    covariance = np.linalg.inv(information(table) + prior)
    values = to_parent @ covariance @ score(table)
    return change.moved(values, to_parent @ covariance @ to_parent.T, np.zeros(6))


def compare_digests(arguments: argparse.Namespace) -> int | None:
    """Print the history of a mount, and return the exit code of ``compare``.

    None is returned if the arguments are no digests.

    Raises
    ------
    ConfigError
        If the arguments name another installed transform than the digests.
    """
    digests = read_digests([Path(path) for path in arguments.results])
    if digests is None:
        return None
    if arguments.installed:
        raise ConfigError("digests contain their installed transform: omit --with")
    changes = find_changes(digests)
    document = None
    if arguments.json:
        rows = [
            {
                "session": digests[item.index].day,
                "sentence": item.shift.what,
                "axes": item.shift.axes,
            }
            for item in changes
        ]
        document = {"sessions": [digest.day for digest in digests], "changes": plain(rows)}
    print_result(_lines(digests, changes), document)
    return 4 if changes else 0


def _lines(digests: Sequence[Digest], changes: Sequence[Changepoint]) -> Iterator[str]:
    """Yield the verdict, and a line for each session and each change."""
    first = digests[0]
    mount = f"Mount of {first.child_frame} on {first.parent_frame}"
    sessions = counted(len(digests), "session")
    if changes:
        newest = changes[-1]
        day = digests[newest.index].day
        yield f"{mount}: moved before {day}: {newest.shift.what} ({sessions})"
    else:
        yield f"{mount}: no change in {sessions}"
    names = "".join(f"{key.replace('_', ' '):>24}" for key in AXIS_KEYS.values())
    yield f"  {'session':<18}{'motion':>8}{names}"
    by_index = {changepoint.index: changepoint for changepoint in changes}
    offset = np.zeros((6, 7))
    for index, digest in enumerate(digests):
        if changepoint := by_index.get(index):
            yield f"  -- moved before {digest.day}: {changepoint.shift.what}"
            offset = np.zeros((6, 7))
        # Sessions since the last change share one offset, so that its standard deviation shrinks.
        offset = offset + _with_wander(digest)
        shift = _shift_of(offset, se3.block_diagonal(se3.rotation_of(digest.installed)))
        cells = [
            f"{amount(axis, row.difference)} +/- {amount(axis, row.sigma)}"
            for axis, row in shift.axes.items()
        ]
        yield f"  {digest.day:<18}{digest.seconds:>6} s" + "".join(f"{cell:>24}" for cell in cells)
