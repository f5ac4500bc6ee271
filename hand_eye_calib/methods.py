"""The methods: one record each, with everything that other code has to know about a method.

The solvers are in :mod:`hand_eye_calib.solvers.registry` and :mod:`hand_eye_calib.gls`.
"""

from typing import NamedTuple

from hand_eye_calib.errors import ConfigError

BACKENDS = ("fast", "ipopt")


class MethodRecord(NamedTuple):
    """Properties of a method: it solves the motion pairs of a reference alone, or (False) uses the
    pose stream as a whole; outliers are left out, so that a few jumps of a stream hardly change the
    answer; and the values of the option ``backend`` that it takes.
    """

    uses_reference: bool = True
    rejects_outliers: bool = False
    backends: tuple[str, ...] = BACKENDS[:1]


METHODS = {
    "auto": MethodRecord(uses_reference=False, rejects_outliers=True),
    "dnlo": MethodRecord(rejects_outliers=True, backends=BACKENDS),
    "dnl": MethodRecord(backends=BACKENDS),
    **dict.fromkeys(("park", "taylor", "zhuang", "ali"), MethodRecord()),
    "adaptive": MethodRecord(uses_reference=False, rejects_outliers=True),
}


def require_backend(method: str, backend: str) -> None:
    """Check that a method has a backend; otherwise a ConfigError names those that have."""
    if backend not in METHODS[method].backends:
        able = [name for name, record in METHODS.items() if backend in record.backends]
        raise ConfigError(
            f"method {method} has no {backend} backend; only {' and '.join(able)} have"
        )
