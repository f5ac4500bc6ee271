#!/bin/sh
# try_dist.sh DIST: install wheel and sdist of the folder DIST in clean environments, calibrate the
# shipped recording there, and print the size of each environment. The sdist is installed with
# Python 3.13, if there is one.
set -eu
dist=$(cd "$1" && pwd)
# Megabytes that the package may take with everything it depends on.
largest=700
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT

try() {
    file=$1
    PYTHON=$2 sh "$(dirname "$0")/make_venv.sh" "$place/env" >/dev/null
    "$place/env/bin/python" -m pip install -qq --disable-pip-version-check "$file"
    (cd "$place" && env/bin/hand_eye_calib calibrate sample:lidar.tum sample:camera.tum --out result |
        head -n 1)
    [ -s "$place/result/report.html" ]
    size=$(du -sm "$place/env" | cut -f 1)
    echo "$(basename "$file") with $("$place/env/bin/python" --version): $size MB"
    [ "$size" -le $largest ] || { echo "more than $largest MB" >&2; exit 1; }
    rm -rf "$place/env" "$place/result"
}

try "$dist"/*.whl "${PYTHON:-python3}"
# A python3.13 on PATH may be a shim of pyenv without a Python behind it.
for other in python3.13 "$HOME"/.pyenv/versions/3.13*/bin/python3.13 "${PYTHON:-python3}"; do
    if "$other" --version >/dev/null 2>&1; then
        try "$dist"/*.tar.gz "$other"
        break
    fi
done
