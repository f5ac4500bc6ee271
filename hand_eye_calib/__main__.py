"""``python -m hand_eye_calib COMMAND``."""

import sys

from hand_eye_calib.python_path import trusted_path

sys.path[:] = trusted_path()

from hand_eye_calib.cli.main import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
