"""``completion SHELL``: what a shell needs to complete commands, options, values and topics."""

import argparse

from hand_eye_calib.errors import MissingDependencyError

EXAMPLES = """\
examples:
  eval "$(hand_eye_calib completion bash)"     in ~/.bashrc; with ROS after its setup.bash
  eval "$(hand_eye_calib completion zsh)"      in ~/.zshrc, after compinit
  hand_eye_calib completion fish | source      in ~/.config/fish/config.fish"""

_SHELLS = ("bash", "zsh", "fish")
_PROGRAM = "hand_eye_calib"

# ros2 completes the package and the executable; what follows is ours.
_OF_ROS2 = r"""
_hand_eye_calib_other="$(complete -p ros2 2>/dev/null | sed -n 's/.* -F \([^ ]*\) .*/\1/p')"
if [[ "$_hand_eye_calib_other" != _hand_eye_calib_ros2 ]]; then
    _hand_eye_calib_of_ros2="$_hand_eye_calib_other"
fi
_hand_eye_calib_ros2() {
    if [[ "${COMP_WORDS[*]:1:2}" != "run hand_eye_calib" || $COMP_CWORD -lt 4 ]]; then
        if [[ -n "$_hand_eye_calib_of_ros2" ]]; then "$_hand_eye_calib_of_ros2" "$@"; fi
        return
    fi
    local start=3
    if [[ "${COMP_WORDS[3]}" == hand_eye_calib ]]; then start=4; fi
    local IFS=$'\013'
    COMPREPLY=($(IFS="$IFS" COMP_LINE="$COMP_LINE" COMP_POINT="$COMP_POINT" \
        COMP_TYPE="$COMP_TYPE" _ARGCOMPLETE_COMP_WORDBREAKS="$COMP_WORDBREAKS" \
        _ARGCOMPLETE=$start _ARGCOMPLETE_SHELL=bash _ARGCOMPLETE_SUPPRESS_SPACE=1 \
        python3 -m hand_eye_calib 8>&1 9>&2 1>/dev/null 2>&1 </dev/null))
}
complete -o default -o bashdefault -F _hand_eye_calib_ros2 ros2
"""


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
    print(shellcode([_PROGRAM], shell=arguments.shell), end="")
    if arguments.shell == "bash":
        print(_OF_ROS2, end="")
    return 0
