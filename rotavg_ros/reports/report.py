"""Writes a run's report: a self-contained report.html, and its pictures as PNG files."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from rotavg_ros.errors import UserError
from rotavg_ros.replay.record import RunRecord
from rotavg_ros.reports import closure_pictures, map_pictures, time_pictures
from rotavg_ros.reports.facts import RunFacts
from rotavg_ros.reports.page import page_of
from rotavg_ros.reports.theme import DARK, LIGHT, Theme
from rotavg_ros.version import __version__
from rotavg_ros.whole_file import replacing


class ReportError(UserError):
    """The report cannot be written; the message names the file."""


class Picture(NamedTuple):
    """A picture of the report; ``draw`` returns None if there is nothing to draw."""

    name: str
    draw: Callable[[RunFacts, Theme], Figure | None]
    title: str
    caption: str


PICTURES = (
    Picture(
        "trajectory",
        map_pictures.trajectory,
        "Trajectory before and after the correction",
        "Where odometry alone puts the robot, and where it was after its orientations were corrected.",
    ),
    Picture(
        "position_error",
        time_pictures.position_error,
        "Position error over time",
        "Distance to the reference. Positions follow from the corrected orientations; false closures do not pull.",
    ),
    Picture(
        "orientation",
        time_pictures.orientation,
        "Orientations over time",
        "Odometry drifts away; loop closures bring it back.",
    ),
    Picture(
        "uncertainty",
        time_pictures.uncertainty,
        "Uncertainty of the orientations over time",
        "One standard deviation about each axis, relative to the first keyframe of the connected part. It grows along "
        "odometry and falls at loop closures.",
    ),
    Picture(
        "graph",
        map_pictures.graph,
        "Loop closures on the map by outlier score",
        "Keyframes in grey; each line is a loop closure. What is believed lies on top; long lines across the map that "
        "are held false connect places that only look alike.",
    ),
    Picture(
        "matches",
        closure_pictures.matches,
        "Moments that loop closures connect, by outlier score",
        "Each dot is a loop closure. A second pass along the same way shows as a line of dots; false closures that "
        "agree with each other (perceptual aliasing) show as a short line of their own.",
    ),
    Picture(
        "scores",
        closure_pictures.scores,
        "Histogram of outlier scores",
        "A clear-cut run has scores at both ends and few in between. The scale is linear up to 10, then logarithmic.",
    ),
    Picture(
        "flips",
        time_pictures.flips,
        "Flags over time",
        "A verdict changes when later evidence contradicts it; a consumer of the flags has to live with that often.",
    ),
    Picture(
        "ticks",
        time_pictures.ticks,
        "Tick times and growth of the graph",
        "A warm tick starts from the last answer, a cold one from scratch, as a batch solve does.",
    ),
)


@dataclass(frozen=True)
class _Drawn:
    """A picture on the page: data URIs for light and dark, its size in CSS pixels."""

    title: str
    caption: str
    light: str
    dark: str
    width: int
    height: int


def write_report(record: RunRecord, folder: Path) -> Path:
    """Write ``report.html`` and a PNG for every picture that has something to draw.

    Files are either complete or missing: each is written beside its place and then moved.

    Args:
        record: the run.
        folder: exists.

    Returns:
        the path of the page.

    Raises:
        ReportError: the folder cannot be written to.
    """
    facts = RunFacts(record)
    pictures = {picture.name: drawn for picture in PICTURES if (drawn := _drawn(picture, facts, folder)) is not None}
    environment = Environment(
        loader=PackageLoader("rotavg_ros.reports"), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    html = environment.get_template("report.html").render(page=page_of(facts), pictures=pictures, version=__version__)
    path = folder / "report.html"
    _write(path, html.encode("utf-8", "replace"))
    return path


def _drawn(picture: Picture, facts: RunFacts, folder: Path) -> _Drawn | None:
    light, dark = (picture.draw(facts, theme) for theme in (LIGHT, DARK))
    if light is None or dark is None:
        return None
    png = _png(light)
    _write(folder / f"{picture.name}.png", png)
    width, height = (round(96 * inches) for inches in light.get_size_inches())
    return _Drawn(picture.title, picture.caption, _data_uri(png), _data_uri(_png(dark)), width, height)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _write(path: Path, content: bytes) -> None:
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise ReportError(f"{path}: cannot be written: {error.strerror}") from None
