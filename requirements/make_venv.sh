#!/bin/sh
# make_venv.sh DIRECTORY: make a virtual environment with pip, with $PYTHON (default python3), even
# if venv comes without ensurepip.
set -eu
directory=$1
python=${PYTHON:-python3}

if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    found=$("$python" --version 2>/dev/null || echo "not there")
    echo "hand_eye_calib needs Python 3.11 or newer; $python is ${found}." \
        "Say which one to use: make PYTHON=python3.12 ..." >&2
    exit 1
fi
[ -x "$directory/bin/python" ] && "$directory/bin/python" -m pip --version >/dev/null 2>&1 && exit 0

echo "making $directory with $("$python" --version)"
if "$python" -m venv "$directory" >/dev/null 2>&1; then exit 0; fi
# Debian and Ubuntu without python3-venv have venv but no ensurepip; pip can install itself into the
# new environment.
if "$python" -m venv --clear --without-pip "$directory" &&
    "$python" -m pip --python "$directory/bin/python" install --quiet pip; then
    exit 0
fi
rm -rf "$directory"
echo "cannot make a virtual environment with $python;" \
    "install python3-venv (apt install python3-venv) and try again" >&2
exit 1
