"""Arguments of vehicles on the command line."""

import argparse
from typing import Any

from hand_eye_calib.core.base.errors import InputError


class NominalAction(argparse.Action):
    """Argument ``--nominal FILE``: set the options of the nominal sizes of wheels.

    A size that its own option sets takes precedence.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Insert the sizes before all other options. Of equal options, the last one counts."""
        # The reader imports NumPy, which the help of a command does not need.
        from hand_eye_calib.extras.vehicle.nominal import nominal_sizes

        try:
            sizes = nominal_sizes(values)
        except InputError as error:
            raise argparse.ArgumentError(self, str(error)) from None
        namespace.options = [*sizes.items(), *(namespace.options or [])]
