"""``python -m hand_eye_calib COMMAND``."""

import sys

from hand_eye_calib.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
