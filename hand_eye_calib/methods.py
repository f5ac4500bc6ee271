"""The methods: one record each, with everything that other code has to know about a method.

The solvers are in :mod:`hand_eye_calib.solvers.registry` and :mod:`hand_eye_calib.gls`.
"""

from dataclasses import dataclass, replace

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
    """

    name: str
    uses_reference: bool = True
    rejects_outliers: bool = False
    backends: tuple[str, ...] = ("fast",)

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


_OF_STREAM = MethodRecord(name="auto", uses_reference=False, rejects_outliers=True)

METHODS = {
    record.name: record
    for record in (
        _OF_STREAM,
        MethodRecord(name="dnlo", rejects_outliers=True, backends=BACKENDS),
        MethodRecord(name="dnl", backends=BACKENDS),
        *(MethodRecord(name=name) for name in ("park", "taylor", "zhuang", "ali")),
        replace(_OF_STREAM, name="adaptive"),
    )
}
