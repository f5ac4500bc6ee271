"""Calibrate two trajectory files, say what may be used, and save the result.

python examples/calibrate_files.py lidar.tum camera.tum result/
"""

import sys

import hand_eye_calib as hec


def main(parent_file: str, child_file: str, directory: str) -> hec.Calibration:
    """Calibrate, print, save."""
    parent = hec.read_trajectory(parent_file, format="auto")
    child = hec.read_trajectory(child_file, format="auto")
    result = hec.calibrate(
        parent, child, parent_frame="lidar", child_frame="camera"
    )
    print(result.headline)
    for reason in result.reasons:
        print(f"- {reason.sentence} {reason.what_to_do}")
    if result.verdict is not hec.Verdict.DO_NOT_USE:
        print("camera in lidar (m):", result.T_parent_child[:3, 3].round(4))
        print("saved to", hec.save(result, directory))
    return result


if __name__ == "__main__":
    main(*sys.argv[1:])
