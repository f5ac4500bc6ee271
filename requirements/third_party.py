"""Write THIRD_PARTY.md: licences of the libraries that the package and its extras use."""

import re
from importlib.metadata import PackageNotFoundError, distribution, requires
from pathlib import Path

PAGE = Path(__file__).parents[1] / "THIRD_PARTY.md"
# Extras for development only; nothing that users install needs them.
DEVELOPMENT = ("test", "lint", "coverage")
# Licences of libraries whose packages state none in a short form; from their source repositories.
OTHERS = {
    "casadi": "LGPL-3.0-or-later",
    "numpy": "BSD-3-Clause",
    "ros-jazzy-common-interfaces": "Apache-2.0",
    "ros-jazzy-rclpy": "Apache-2.0",
    "segno": "BSD-3-Clause",
}

HEAD = """\
# Licences of other libraries

hand_eye_calib contains no code of these libraries; pip installs them. Their licences are those that
their packages state. Written by `python requirements/third_party.py`.

| Library | Needed for | Licence |
| --- | --- | --- |
"""


def libraries() -> list[tuple[str, str]]:
    """Return the names of the libraries, each with the extra that needs it."""
    found = []
    for requirement in requires("hand_eye_calib") or ():
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        extra = re.search(r"extra == ['\"](\w+)['\"]", requirement)
        if not extra or extra[1] not in DEVELOPMENT:
            found.append((name, f"`[{extra[1]}]`" if extra else "everything"))
    return found


def licence(name: str) -> str:
    """Return the licence that an installed library states; empty if it is not installed."""
    if name in OTHERS:
        return OTHERS[name]
    try:
        about = distribution(name).metadata
    except PackageNotFoundError:
        return ""
    stated = about.get("License-Expression") or about.get("License") or ""
    if stated and len(stated) < 40:
        return stated.strip()
    classifiers = [
        text for text in about.get_all("Classifier") or () if "License" in text
    ]
    return classifiers[0].rpartition(" :: ")[2] if classifiers else ""


if __name__ == "__main__":
    rows = [
        f"| {name} | {use} | {licence(name) or 'see its page'} |"
        for name, use in libraries()
    ]
    PAGE.write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")
