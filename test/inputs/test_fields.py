"""Precisions out of matrices, and names of edges."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.inputs.fields import edge_id_of, precision_of_covariance, precision_of_information


def test_precision_agrees_with_the_spread_of_rotation_vectors() -> None:
    rng = np.random.default_rng(0)
    deviation = 0.05
    vectors = rng.normal(scale=deviation, size=(20_000, 3))
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.cov(vectors.T)
    information = np.zeros((6, 6))
    information[3:, 3:] = np.linalg.inv(covariance[3:, 3:])
    assert precision_of_covariance(covariance.ravel()) == pytest.approx(deviation**-2, rel=0.03)
    assert precision_of_information(information.ravel()) == pytest.approx(deviation**-2, rel=0.03)
    assert precision_of_covariance(np.zeros(36)) == precision_of_information(np.zeros(36)) == 0.0
    assert precision_of_covariance(np.full(36, np.nan)) == 0.0  # from a sender who knows none
    assert precision_of_covariance(-covariance.ravel()) < 0  # refused later, as bad_precision


def test_names_of_edges_say_which_robots_they_join() -> None:
    ends = [(robot, number) for robot in ("a", "b", "ab", "é") for number in (5, 7)]
    names = [edge_id_of(source, target, kind) for source in ends for target in ends for kind in (0, 1)]
    within = [[edge_id_of((robot, 5), (robot, 7), kind) for kind in (0, 1)] for robot in ("a", "b")]
    assert within == [[5 << 32 | 7, 1 << 63 | 5 << 32 | 7]] * 2  # the robot of the source is named beside the id
    # Of 8 · 6 · 2 edges between robots none shares a name; within a robot there are 2 · 2 · 2.
    assert len(set(names)) == 96 + 8 and all(0 <= name < 2**64 for name in names)


def test_names_of_edges_are_the_same_in_every_run() -> None:
    """State files and the labels in them outlive the process."""
    assert edge_id_of(("a", 5), ("b", 7), 1) == 14346040074212964179
    assert edge_id_of(("a", 5), ("b", 7), 0) == 14346040074212964179 - 2**63


def test_names_of_edges_tell_symbols_apart() -> None:
    """gtsam's keys have a letter in their highest byte: a0, b0, x0 …"""
    keys = [("r", ord(letter) << 56 | number) for letter in "abx" for number in (0, 1)] + [("r", 0), ("r", 1)]
    names = [edge_id_of(source, target, 1) for source in keys for target in keys]
    assert len(set(names)) == 64 and all(2**63 <= name < 2**64 for name in names)
