"""Digests: the information on the mount from a monitored session, in a file below 10 kB.

A digest contains the information matrix H and the score S of the whole session on a shift of the
child sensor from the installed extrinsic (:mod:`hand_eye_calib.core.assessment.moved`). Both are
divided by the long-run variance of the scores, so that H and S of several sessions can be added.
"""

import json
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from hand_eye_calib.core.base.arrays import FloatArray
from hand_eye_calib.core.base.errors import InputError
from hand_eye_calib.core.base.plain import from_plain, plain

# Name of the folder of digests in the output directory of the node.
FOLDER = "digests"

# First key in the file of a digest, which other JSON files do not have.
_KIND = "mount_digest"

# Shapes of the arrays in a digest.
_SHAPES = {
    "installed": (4, 4),
    "covariance": (6, 6),
    "wander": (6, 6),
    "evidence": (6, 7),
    "evidence_since": (6, 7),
}

# Larger files (bytes) are not read, because they are no digests.
_LARGEST = 100_000


@dataclass(frozen=True, eq=False)
class Digest:
    """Information on the mount from one monitored session.

    Attributes
    ----------
    parent_frame, child_frame : str
    start_ns, end_ns : int
        Stamps of the first and last second of motion (ns).
    seconds : int
        Duration of the motion (s).
    installed : (4, 4) array
        Installed pose of the child sensor in the parent sensor's frame.
    covariance : (6, 6) array
        Covariance of the offset from the installed extrinsic that exists without a shift, in the
        child's frame.
    wander : (6, 6) array
        Covariance of the part of this offset that differs from session to session, in the child's
        frame.
    evidence : (6, 7) array
        Information H and score S, ``[H S]``, on a shift in the child's frame.
    alarm : str
        Text of the monitor's alarm; empty without an alarm.
    since_ns : int
        Approximate time of the shift that raised the alarm (ns); 0 without an alarm.
    seconds_since : int
        Duration of the motion since this time (s).
    evidence_since : (6, 7) array
        Part of the evidence since this time.
    """

    parent_frame: str
    child_frame: str
    start_ns: int
    end_ns: int
    seconds: int
    installed: FloatArray
    covariance: FloatArray
    wander: FloatArray
    evidence: FloatArray
    alarm: str = ""
    since_ns: int = 0
    seconds_since: int = 0
    evidence_since: FloatArray = field(default_factory=lambda: np.zeros((6, 7)))

    def parts(self) -> "list[Digest]":
        """Return the session, divided at the shift that raised its alarm.

        The part after the shift has the alarm. If the shift is at the start of the session, there
        is only one part.
        """
        n_before = self.seconds - self.seconds_since
        if not self.since_ns or n_before <= 0:
            return [self]
        before = replace(
            self,
            end_ns=self.since_ns,
            seconds=n_before,
            evidence=self.evidence - self.evidence_since,
            alarm="",
            since_ns=0,
        )
        since = replace(
            self,
            start_ns=self.since_ns,
            seconds=self.seconds_since,
            evidence=self.evidence_since,
        )
        return [before, since]

    @property
    def day(self) -> str:
        """Date and time of the first motion (UTC), as text."""
        start = datetime.fromtimestamp(self.start_ns * 1e-9, UTC)
        return start.strftime("%Y-%m-%d %H:%M")


def write_digest(directory: Path, digest: Digest) -> Path:
    """Write a digest into the folder ``digests`` of an output directory, and return its path.

    The file is named after the start of the session, so that sorted names are in order of time.
    """
    folder = directory / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    start = datetime.fromtimestamp(digest.start_ns * 1e-9, UTC)
    path = folder / f"{start:%Y%m%d_%H%M%S}.json"
    path.write_text(json.dumps({_KIND: 1, **plain(digest)}), encoding="utf-8")
    return path


def read_digest(path: Path) -> Digest | None:
    """Return the digest in a file; None for any other file.

    Raises
    ------
    InputError
        If the file is a digest with missing or invalid values.
    """
    if (
        not path.is_file()
        or path.stat().st_size > _LARGEST
        or path.suffix != ".json"
    ):
        return None
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(document, dict) or document.pop(_KIND, None) != 1:
        return None
    try:
        for name, shape in _SHAPES.items():
            values = np.array(document[name], dtype=float)
            document[name] = values
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(f"{name} must be {shape} finite numbers")
        digest: Digest = from_plain(Digest, document)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is no usable digest: {error}") from None
    return digest


def read_digests(paths: list[Path]) -> list[Digest] | None:
    """Return the digests in files and folders, in order of time.

    The result is None if a path has no digests, or has another kind of file.

    Raises
    ------
    InputError
        If a digest has invalid values, or if the digests are of different mounts.
    """
    digests = []
    for path in paths:
        # The path may be an output directory of the node, a folder of digests, or a digest.
        folder = path / FOLDER if (path / FOLDER).is_dir() else path
        files = sorted(folder.glob("*.json")) if folder.is_dir() else [folder]
        read = [read_digest(file) for file in files]
        if not read or None in read:
            return None
        digests += [digest for digest in read if digest is not None]
    digests.sort(key=lambda digest: digest.start_ns)
    first = digests[0]
    for digest in digests[1:]:
        frames = digest.parent_frame, digest.child_frame
        if frames != (first.parent_frame, first.child_frame):
            raise InputError(
                f"digests of different mounts: {first.child_frame} in {first.parent_frame}, and "
                f"{digest.child_frame} in {digest.parent_frame}"
            )
        if not np.allclose(digest.installed, first.installed, atol=1e-9):
            raise InputError(
                f"the installed transform changed before {digest.day}: compare the digests since "
                "then"
            )
    return digests
