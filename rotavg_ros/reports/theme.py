"""Colours of the pictures on a light and on a dark page; colour-blind readers can tell them apart."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

WIDTH = 5.6  # inches, for every picture: the text is readable on a phone as well
_PIXELS_PER_INCH = 170
_LONGEST_LABEL = 20
_TITLE_PAD, _LEGEND_ROW = 8, 15  # points
_DASHES = ("-", (0, (3, 1, 1, 1)), (0, (1, 1)))  # short enough for the legend


@dataclass(frozen=True)
class Theme:
    """Colours by meaning.

    Attributes:
        name: ``light`` or ``dark``.
        background, ink, muted, grid: of the picture; text in ``muted`` has a contrast of 5 : 1 and more.
        odometry, corrected, reference: trajectories and errors before and after.
        kept, flagged: loop closures that are believed and those that are not.
        missed, wrongly_flagged: verdicts that the truth contradicts.
        between: closures with a score of 0.5.
        robots: one colour each, repeated cyclically with other dashes, see :meth:`line_of`.
    """

    name: str
    background: str
    ink: str
    muted: str
    grid: str
    odometry: str
    corrected: str
    reference: str
    kept: str
    flagged: str
    missed: str
    wrongly_flagged: str
    between: str
    robots: tuple[str, ...]

    @property
    def scores(self) -> Colormap:
        """Colours from a score of 0 (believed) to 1 (false)."""
        return LinearSegmentedColormap.from_list("scores", [self.kept, self.between, self.flagged])

    def line_of(self, robot: int) -> dict[str, Any]:
        """Colour and dashes of a robot's lines, counted from 0; they differ up to three times as many as colours."""
        turn, colour = divmod(robot, len(self.robots))
        return {"color": self.robots[colour], "linestyle": _DASHES[turn % len(_DASHES)]}

    def figure(self, width: float, height: float) -> Figure:
        """An empty picture; the size in inches."""
        return Figure(figsize=(width, height), dpi=_PIXELS_PER_INCH, facecolor=self.background, layout="constrained")

    def dress(self, axes: Axes, title: str, x: str = "", y: str = "", *, legend_rows: int = 0) -> None:
        """Give a panel its look, its title and the names of its axes.

        Args:
            legend_rows: number of rows of the legend between title and panel; 0 for none.
        """
        style(axes, title, ink=self.ink, muted=self.muted, grid=self.grid)
        pad = _TITLE_PAD + _LEGEND_ROW * legend_rows
        axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=self.ink, pad=pad)
        axes.set_facecolor(self.background)
        if legend_rows:
            names = len(axes.get_legend_handles_labels()[1])
            axes.legend(
                loc="lower left",
                bbox_to_anchor=(-0.01, 0.985),
                ncol=-(-names // legend_rows),
                frameon=False,
                fontsize=9,
                labelcolor=self.ink,
                handlelength=1.3,
                columnspacing=1.3,
                borderaxespad=0.2,
            )
        axes.set_xlabel(x, fontsize=9, color=self.muted)
        axes.set_ylabel(y, fontsize=9, color=self.muted)


def style(axes: Axes, title: str, *, ink: str, muted: str, grid: str) -> None:
    """The common style of all pictures, whatever their colours."""
    axes.set_title(title, loc="left", fontsize=11, color=ink, pad=8)
    axes.grid(color=grid, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(which="both", colors=muted, labelsize=9, length=0)
    for side in axes.spines.values():
        side.set_visible(False)


def plain(name: str) -> str:
    """A name from outside as a short label that matplotlib draws literally: neither mathematics nor hidden.

    Of a long name the middle is left out: robots' names often differ at the end alone.
    """
    shown = drawable(name)
    if len(shown) > _LONGEST_LABEL:
        half = _LONGEST_LABEL // 2
        shown = f"{shown[:half]}…{shown[half + 1 - _LONGEST_LABEL :]}"
    label = shown.replace("$", r"\$")
    return f"\u200a{label}" if label.startswith("_") else label


def drawable(text: str) -> str:
    """A text from outside with a question mark for every letter that the font lacks, or that is not printable."""
    letters = _letters()
    return "".join(letter if letter.isprintable() and ord(letter) in letters else "?" for letter in text)


@cache
def _letters() -> frozenset[int]:
    """Unicode numbers of the letters that the font has, both in regular and in bold."""
    regular, bold = (
        frozenset(get_font(findfont(FontProperties(weight=weight))).get_charmap()) for weight in ("normal", "bold")
    )
    return regular & bold


LIGHT = Theme(
    name="light",
    background="#ffffff",
    ink="#1f2933",
    muted="#52606d",
    grid="#e4e7eb",
    odometry="#d9731a",
    corrected="#1f62bd",
    reference="#1f2933",
    kept="#1f62bd",
    flagged="#cf3f0a",
    missed="#a02a91",
    wrongly_flagged="#b58900",
    between="#c3c9d0",
    robots=("#1f62bd", "#00795a", "#a0468c", "#8a6d00", "#0f7f9c", "#6b4fb3"),
)
DARK = Theme(
    name="dark",
    background="#171c23",
    ink="#e6ebf0",
    muted="#a3b0bd",
    grid="#2c343d",
    odometry="#f0a04b",
    corrected="#6aaefc",
    reference="#e6ebf0",
    kept="#6aaefc",
    flagged="#ff7a45",
    missed="#e58fd6",
    wrongly_flagged="#e3c04b",
    between="#66717d",
    robots=("#6aaefc", "#3fbf99", "#dd8fca", "#d6b53c", "#57c4de", "#a992f0"),
)
