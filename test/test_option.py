"""Options: what they take, in which unit, and what they say when they refuse."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.option import DEGREES, METRES, OptionError, check_options, documented, option, options_of


@documented
@dataclass(frozen=True)
class Camera:
    """A camera."""

    tilt: float = option(30.0, "how far it looks down", within=(-90.0, 90.0), unit=DEGREES)
    height: float = option(1.5, "above the floor", unit=METRES)
    lens: str = option("wide", "what is in front", choices=("wide", "tele"), live=True)
    shots: int = option(3, "pictures at a time", within=(1, 10))
    flash: bool = option(False, "whether it flashes")
    tags: tuple[str, ...] = option(("a",), "names")
    matrix: tuple[float, ...] = option((1.0, 0.0), "numbers")
    serial: str = field(default="not an option")

    def __post_init__(self) -> None:
        check_options(self)


OPTIONS = {each.name: each for each in options_of(Camera)}


def test_names_and_defaults_are_as_users_write_them() -> None:
    assert {name: each.default for name, each in OPTIONS.items()} == {
        "tilt_deg": 30.0,
        "height_m": 1.5,
        "lens": "wide",
        "shots": 3,
        "flash": False,
        "tags": ("a",),
        "matrix": (1.0, 0.0),
    }
    assert Camera().tilt == math.radians(30)
    assert all(each.written(Camera()) == each.default for each in OPTIONS.values())


@given(st.integers(-90_000_000, 90_000_000))
def test_degrees_come_back_as_they_were_written(millionths: int) -> None:
    tilt = OPTIONS["tilt_deg"]
    degrees = millionths / 1e6
    assert tilt.to_field(degrees) == pytest.approx(math.radians(degrees), rel=1e-15)
    assert tilt.written(Camera(tilt=tilt.to_field(degrees))) == degrees


@pytest.mark.parametrize(
    ("name", "written", "taken"),
    [
        ("tilt_deg", 5, 5.0),
        ("tilt_deg", np.float32(0.5), 0.5),
        ("tilt_deg", Fraction(1, 2), 0.5),
        ("shots", np.int64(4), 4),
        ("tags", [], ()),
        ("matrix", [1, 2.5], (1.0, 2.5)),
        ("matrix", np.array([1.0, 2.0]).tolist(), (1.0, 2.0)),
    ],
)
def test_values_become_of_the_options_own_type(name: str, written: object, taken: object) -> None:
    value = OPTIONS[name].checked(written)
    assert value == taken and type(value) is type(taken)


@pytest.mark.parametrize(
    ("name", "written", "message"),
    [
        ("tilt_deg", 91, "tilt_deg is 91.0; it must be between -90 and 90"),
        ("tilt_deg", math.nan, "tilt_deg is nan; it must be between -90 and 90"),
        ("tilt_deg", "5", "tilt_deg is '5'; it must be a number"),
        ("tilt_deg", True, "tilt_deg is True; it must be a number"),
        ("height_m", None, "height_m is None; it must be a number"),
        ("lens", "fish", "lens is 'fish'; choose from wide, tele"),
        ("lens", 5, "lens is 5; it must be text"),
        ("shots", 11, "shots is 11; it must be between 1 and 10"),
        ("shots", 2.0, "shots is 2.0; it must be a whole number"),
        ("flash", 1, "flash is 1; it must be true or false"),
        ("tags", "a", "tags is 'a'; it must be a list of texts"),
        ("tags", [1], "tags is [1]; it must be a list of texts"),
        ("matrix", ["x"], "matrix is ['x']; it must be a list of numbers"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(name: str, written: object, message: str) -> None:
    with pytest.raises(OptionError) as refusal:
        OPTIONS[name].checked(written)
    assert str(refusal.value) == message


def test_a_dataclass_is_checked_in_the_unit_that_users_write() -> None:
    Camera(tilt=math.radians(90), height=math.inf)  # the bound itself; a height has none
    with pytest.raises(OptionError, match=r"^tilt_deg is 572\.957795130823; it must be between -90 and 90$"):
        Camera(tilt=10)
    with pytest.raises(OptionError, match=r"^tilt_deg is 'flat'; it must be a number$"):
        Camera(tilt="flat")  # type: ignore[arg-type]


def test_help_tells_every_option() -> None:
    said = " ".join((Camera.__doc__ or "").split())
    assert said.startswith("A camera. Attributes:")
    assert "tilt: how far it looks down (in radians; tilt_deg: default 30.0; -90 … 90)." in said
    assert "lens: what is in front (default 'wide'; one of wide, tele)." in said
    assert "flash: whether it flashes (default False)." in said
    assert "serial" not in said
