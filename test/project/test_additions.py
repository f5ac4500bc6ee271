"""A new solver and a new reference, added to a copy of the package as docs/architecture.md says."""

import os
import subprocess
import sys

from package_copy import WITHOUT_FINDER, copy_of_the_package

HORAUD = '''
"""Unit quaternions, then a linear solution of the translation: Horaud and Dornaika 1995."""

import numpy as np
from scipy.spatial.transform import Rotation

from hand_eye_calib.core.geometry import se3
from hand_eye_calib.core.solvers.all_pairs import Solution, translation_equations


def solve(pairs):
    """Minimise the sum of |a q - q b|^2 over unit quaternions q."""
    a = se3.to_quat_xyzw(pairs.Ts_parenti_parentj)
    b = se3.to_quat_xyzw(pairs.Ts_childi_childj)
    rows = left(a) - right(b)
    q = np.linalg.eigh(np.einsum("kij,kil->jl", rows, rows))[1][:, 0]
    R = Rotation.from_quat(q).as_matrix()
    equations, targets = translation_equations(pairs, R)
    t = np.linalg.lstsq(equations.reshape(-1, 3), targets.ravel(), rcond=None)[0]
    return Solution(se3.from_rotation_translation(R, t), 0.0, True, np.ones(len(pairs)))


def left(quats):
    """Matrices (K, 4, 4) of q -> a q, in the order x y z w."""
    x, y, z, w = np.where(quats[:, 3:] < 0.0, -quats, quats).T
    matrices = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
    return matrices.transpose(2, 0, 1)


def right(quats):
    """Matrices (K, 4, 4) of q -> q b."""
    x, y, z, w = np.where(quats[:, 3:] < 0.0, -quats, quats).T
    matrices = np.array([[w, z, -y, x], [-z, w, x, y], [y, -x, w, z], [-x, -y, -z, w]])
    return matrices.transpose(2, 0, 1)
'''

# Pairs that are some travelled distance apart, as D<n> with n in centimetres.
TRAVELLED = """\
    if kind == "D":
        steps_m = np.linalg.norm(np.diff(Ts_pw_p[:, :3, 3], axis=0), axis=1)
        travelled_m = np.append(0.0, np.cumsum(steps_m))
        i = np.searchsorted(travelled_m, travelled_m - step / 100.0, side="right") - 1
        j = np.flatnonzero(i >= 0)
        return pairs_between(Ts_pw_p, Ts_cw_c, i[j], j)
"""

# What a reference needs: file, text that stands there once, text in its place.
REFERENCE = [
    ("core/base/text.py", "|C([2-9]|", "|D[1-9][0-9]{0,8}|C([2-9]|"),
    (
        "core/pairing/motion_pairs.py",
        "    n_poses = len(Ts_pw_p)\n    if kind",
        f"    n_poses = len(Ts_pw_p)\n{TRAVELLED}    if kind",
    ),
    (
        "core/base/config.py",
        "C<n> (each with",
        "D<n> (n cm apart), C<n> (each with",
    ),
]

# What a solver needs besides its own file.
SOLVER = [
    ("core/solvers/registry.py", "    dnlo,\n", "    dnlo,\n    horaud,\n"),
    (
        "core/solvers/registry.py",
        '    "ali":',
        '    "horaud": _Solver(horaud.solve),\n    "ali":',
    ),
    ("core/base/config.py", '"zhuang", "ali")', '"zhuang", "ali", "horaud")'),
    (
        "offline/calibrate.py",
        '    "ali",\n',
        '    "ali",\n    "horaud",\n',
    ),
]

USE = """
import hand_eye_calib as hec

drive = hec.simulate(0, poses=300)
options = dict(argument.split("=") for argument in sys.argv[1:])
result = hec.calibrate(drive.parent, drive.child, **options)
error_m = abs(result.T_parent_child - drive.T_parent_child)[:3, 3].max()
print(result.status.value, result.method, result.reference, error_m < 0.1)
"""


def calibrated(copy, changes, options):
    """Change texts of a copy of the package, and return the lines that ``USE`` prints there."""
    for name, before, after in changes:
        file = copy / name
        text = file.read_text(encoding="utf-8")
        assert text.count(before) == 1, (name, before)
        file.write_text(text.replace(before, after), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_FINDER + USE, *options],
        cwd=copy.parent,
        env=os.environ | {"PYTHONPATH": str(copy.parent)},
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    return done.stdout.splitlines()


def test_a_new_solver_is_a_file_and_four_lines(tmp_path):
    copy = copy_of_the_package(tmp_path)
    (copy / "core" / "solvers" / "horaud.py").write_text(
        HORAUD, encoding="utf-8"
    )
    lines = calibrated(copy, SOLVER, ["method=horaud", "reference=B5"])
    assert lines[0] == "ok horaud B5 True"


def test_a_new_reference_is_nine_lines_in_three_files(tmp_path):
    copy = copy_of_the_package(tmp_path)
    lines = calibrated(copy, REFERENCE, ["method=dnlo", "reference=D100"])
    assert lines[0] == "ok dnlo D100 True"
