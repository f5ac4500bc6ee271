"""The methods: one record each, with everything that other code has to know about a method.

The solvers are in :mod:`hand_eye_calib.solvers.registry` and :mod:`hand_eye_calib.gls`.
"""

from dataclasses import dataclass

from hand_eye_calib.errors import ConfigError

BACKENDS = ("fast", "ipopt")


@dataclass(frozen=True, kw_only=True)
class MethodRecord:
    """Properties of a method.

    Attributes
    ----------
    name : str
        Value of the option ``method``; "auto" chooses between dnlo and adaptive.
    uses_reference : bool
        It solves the motion pairs of a reference alone. False: it uses the pose stream as a whole.
    rejects_outliers : bool
        Outliers are left out, so that a few jumps of a stream hardly change the answer.
    backends : tuple of str
        Values of the option ``backend`` that it takes.
    most_poses_of_many, most_poses_of_few : int
        Largest number of poses for a cross-check of about ten solves, and for one of two: a second
        or so each. More poses are downsampled to that.
    parts : int
        Number of growing parts of the recording in the convergence figure.
    """

    name: str
    uses_reference: bool = True
    rejects_outliers: bool = False
    backends: tuple[str, ...] = ("fast",)
    most_poses_of_many: int = 3_000
    most_poses_of_few: int = 3_000
    parts: int = 10

    def require_backend(self, backend: str) -> None:
        """Check that the method has a backend.

        Raises
        ------
        ConfigError
            If it has not; the message names the methods that have.
        """
        if backend not in self.backends:
            able = [record.name for record in METHODS.values() if backend in record.backends]
            raise ConfigError(
                f"method {self.name} has no {backend} backend; only {' and '.join(able)} have"
            )


def _of_stream(name: str) -> MethodRecord:
    """The record of a method that uses the pose stream as a whole."""
    return MethodRecord(
        name=name,
        uses_reference=False,
        rejects_outliers=True,
        most_poses_of_many=600,
        most_poses_of_few=600,
        parts=4,
    )


def _of_quadratic_form(name: str, rejects_outliers: bool) -> MethodRecord:
    """The record of a method whose time hardly depends on the number of poses."""
    return MethodRecord(
        name=name,
        rejects_outliers=rejects_outliers,
        backends=BACKENDS,
        most_poses_of_many=20_000,
        most_poses_of_few=50_000,
    )


METHODS = {
    record.name: record
    for record in (
        _of_stream("auto"),
        _of_quadratic_form("dnlo", rejects_outliers=True),
        _of_quadratic_form("dnl", rejects_outliers=False),
        *(MethodRecord(name=name) for name in ("park", "taylor", "zhuang", "ali")),
        _of_stream("adaptive"),
    )
}
