"""``completion SHELL``: what a shell needs to complete commands, options, values and topics."""

import argparse

from hand_eye_calib.errors import MissingDependencyError

EXAMPLES = """\
examples:
  eval "$(hand_eye_calib completion bash)"     in ~/.bashrc
  eval "$(hand_eye_calib completion zsh)"      in ~/.zshrc, after compinit
  hand_eye_calib completion fish | source      in ~/.config/fish/config.fish"""

_SHELLS = ("bash", "zsh", "fish")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = EXAMPLES
    parser.add_argument("shell", metavar="SHELL", choices=_SHELLS, help=", ".join(_SHELLS))


def run(arguments: argparse.Namespace) -> int:
    """Print the code that the shell evaluates."""
    try:
        from argcomplete import shellcode
    except ModuleNotFoundError:
        raise MissingDependencyError(
            "completion needs the package argcomplete, which is not installed: "
            "pip install 'hand_eye_calib[completion]', or apt install python3-argcomplete"
        ) from None
    print(shellcode(["hand_eye_calib"], shell=arguments.shell), end="")
    return 0
