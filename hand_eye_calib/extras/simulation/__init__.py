"""Simulation of drives with a known extrinsic, and the demo."""

from typing import Any

from hand_eye_calib.core.base.registry import COMMANDS, PUBLIC_NAMES, Command


def register() -> None:
    """Register the commands ``simulate`` and ``demo``."""
    PUBLIC_NAMES["simulate"] = "hand_eye_calib.extras.simulation.drive"
    COMMANDS["simulate"] = Command(
        "simulate trajectories or a bag with known truth", _simulate
    )
    COMMANDS["demo"] = Command(
        "simulate a recording and calibrate from it, offline and live", _demo
    )


def _simulate() -> Any:
    """Return the module of the command ``simulate``."""
    from hand_eye_calib.extras.simulation import simulate

    return simulate


def _demo() -> Any:
    """Return the module of the command ``demo``."""
    from hand_eye_calib.extras.simulation import demo

    return demo
