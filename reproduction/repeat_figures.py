"""The figure of ``python -m reproduction repeats``: scatter of repeats over stated sigma."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from hand_eye_calib.report import style

_LOOKS = {
    "x": (style.VERMILION, "o"), "y": (style.GREEN, "o"), "z": (style.BLUE, "o"),
    "roll": (style.VERMILION, "x"), "pitch": (style.GREEN, "x"), "yaw": (style.BLUE, "x"),
}  # fmt: skip
_RANGE = (0.05, 10.0)


def draw_ratios(
    title: str,
    ratios: Mapping[str, Mapping[str, Mapping[str, float]]],
    chance: tuple[float, float],
    stem: Path,
) -> list[Path]:
    """One panel per method, one row per set, one mark per axis.

    Parameters
    ----------
    title : str
    ratios : dict
        Method to data set to axis to ratio.
    chance : (float, float)
        Where 95 % of the ratios would lie if every sigma were right.
    stem : pathlib.Path
        Files without their ending.

    Returns
    -------
    list of pathlib.Path
    """
    with style.house_style():
        note = (
            "1: the sigma was right. Dotted: a factor of two. Grey: 95 % of all marks would "
            "be here by chance"
        )
        figure = style.new_page(2.6, title, note)
        axes = figure.subplots(1, len(ratios), sharey=True, squeeze=False)[0]
        for ax, (method, of_sets) in zip(axes, ratios.items(), strict=True):
            ax.axvspan(*chance, color=style.LIGHT_GREY, alpha=0.5, lw=0)
            for value, dashes in ((0.5, ":"), (1.0, "-"), (2.0, ":")):
                ax.axvline(value, color=style.GREY, lw=0.6, ls=dashes)
            for row, of_axes in enumerate(of_sets.values()):
                for place, (axis, (colour, marker)) in enumerate(_LOOKS.items()):
                    if axis in of_axes:
                        shown = min(max(of_axes[axis], _RANGE[0]), _RANGE[1])
                        ax.plot(
                            shown,
                            row + 0.1 * (place - 2.5),
                            marker=marker,
                            color=colour,
                            ls="",
                            mew=0.8,
                        )
            ax.set_title(method)
            ax.set_xscale("log")
            ax.set_xlim(*_RANGE)
            ax.set_yticks(range(len(of_sets)), list(of_sets))
            style.plain_decades(ax.xaxis, (1, 2, 5))
        axes[0].invert_yaxis()
        handles = [
            style.handle(axis, colour, marker, "") for axis, (colour, marker) in _LOOKS.items()
        ]
        figure.legend(handles=handles, loc="outside upper right", ncols=len(_LOOKS), frameon=False)
        return style.save(figure, stem)
