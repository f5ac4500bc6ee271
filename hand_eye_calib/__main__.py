"""``python -m hand_eye_calib COMMAND``."""

import sys

from hand_eye_calib.core.base.python_path import trusted_path

sys.path[:] = trusted_path()

from hand_eye_calib.offline.cli.main import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
