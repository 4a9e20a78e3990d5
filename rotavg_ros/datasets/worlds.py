"""The worlds that a simulated robot can drive in, by name."""

from __future__ import annotations

from enum import Enum


class World(str, Enum):
    """Where the robot drives."""

    CORRIDOR = "corridor"  # one bent corridor, up and down
    BUILDING = "building"  # laps of a rectangular corridor with rooms to look into
    GRID = "grid"  # a random walk on a lattice, as in the Manhattan datasets
    CITY = "city"  # rectangles of city blocks, all through one home crossing
    LAPS = "laps"  # one smooth closed track, again and again
    ROAM = "roam"  # aimless driving in a square
    SPHERE = "sphere"  # a spiral over a sphere
    TORUS = "torus"  # a coil around a torus
    GARAGE = "garage"  # up the ramps of a parking garage and down again


PLANAR_WORLDS = (World.CORRIDOR, World.BUILDING, World.GRID, World.CITY, World.LAPS, World.ROAM)
# Those of :mod:`rotavg_ros.datasets.simulation.robot_run`.
ROBOT_WORLDS = (World.BUILDING.value, World.CITY.value)
