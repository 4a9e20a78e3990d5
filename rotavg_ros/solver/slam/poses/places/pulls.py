"""Weights of closures, given the probabilities of their error classes, and their contribution to noise estimates."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.poses.closures import GOOD, NOTHING, REPEATS, Places, Scale, Told
from rotavg_ros.solver.slam.poses.places.classes import BY_ITSELF, CLASSES, Said, log_sum, over_components
from rotavg_ros.solver.slam.poses.priors import PlacePriors


def pulled(said: Said, told: Told, log_class: np.ndarray, number: np.ndarray) -> Places:
    """Probabilities, weights and noise sums from the joint densities of classes.

    Args:
        said: densities in each class, given all else.
        told: which translations are known, and runs.
        log_class: ``(J + 1, C)`` nats, joint log densities of closures and classes; false rotations last.
        number: ``(C,)`` number of closures with about the same discrepancy.
    """
    known, k = told.is_known, said.turns
    log_density = log_sum(log_class)
    chance = np.exp(log_class - log_density)
    weight = np.where(known, _shift_weight(said, told, (log_class, chance), number), 0.0)
    square = (said.predictions.mean[:, k:] ** 2).sum(axis=1)
    turn_weight, turn_squares, turn_freedom = _of_turns(said, chance)
    good = slice(GOOD)
    at_good, total = chance[good, :, None] * known[:, None], said.total[good]
    floor = np.stack((said.scale.floor_share, 1 - said.scale.floor_share))[:, None, :, None]
    own, axes = said.variance[good, :, None] * floor, (1, 2, 3)
    return Places(
        chance,
        np.maximum(weight, _least_weight(square, said.scale)),
        turn_weight,
        np.append(turn_squares, (at_good * own * said.along[good] ** 2 / total**2).sum(axis=axes)),
        np.append(turn_freedom, (at_good * own / total).sum(axis=axes)),
        log_density,
        *said.errors(),
        said.scale.shape.even,
        _along_body(said, chance[good] * known),
    )


def nothing_known(told: Told, priors: PlacePriors, is_good: np.ndarray, square: np.ndarray, scale: Scale) -> Places:
    """Before any solve: translations have no weight, rotations weigh as labelled, wrong places have prior probability.

    Args:
        told: results of rotations alone.
        priors: prior parameters of places.
        is_good: ``(C,)`` labels.
        square: ``(C,)`` m², squared residuals of translations.
        scale: scales of errors.
    """
    chance = np.zeros((CLASSES, len(is_good)))
    wrong = priors.wrong_place / priors.counted
    chance[0], chance[GOOD], chance[-1] = is_good * (1 - wrong), is_good * wrong, ~is_good
    turn = np.where(is_good, 1.0, NOTHING) / told.rotation_variance
    none = np.zeros_like(chance)
    zeros = np.zeros(3), np.zeros(3), np.zeros(len(is_good))
    even = scale.shape.even
    return Places(chance, _least_weight(square, scale), turn, *zeros, none, none, even, np.zeros((2, *even.shape[1:])))


def _shift_weight(said: Said, told: Told, classes: tuple[np.ndarray, np.ndarray], number: np.ndarray) -> np.ndarray:
    """``(C,)`` m⁻²: weight of the one normal density that gives the same mean as all classes together.

    n closures that all join the same wrong places, in a run or with equal discrepancies, give evidence of these places
    once, not n times: each repeat has n times the variance of the class that it would be in independently.
    """
    log_class, chance = classes
    alone = np.exp(log_class[BY_ITSELF] - log_sum(log_class[BY_ITSELF]))
    number = np.maximum(np.bincount(told.run, chance[REPEATS])[told.run], number)
    each = np.concatenate((chance[:REPEATS], chance[REPEATS] * alone))[:, :, None]
    variance = np.concatenate((said.variance[:-1], number * said.variance[BY_ITSELF]))[:, :, None]
    total = np.concatenate((said.spread[:-1], said.spread[BY_ITSELF])) + variance
    components = total.shape[2]
    pull = over_components(each / total).sum(axis=0) / components
    shrunk = over_components(each * variance / total).sum(axis=0) / components + chance[-1]
    return np.asarray(pull / shrunk)


def _along_body(said: Said, chance: np.ndarray) -> np.ndarray:
    """``(2, m, m)`` squares and freedom of what has a shape (:func:`~even_shifts.likeliest_shape`).

    Args:
        said: densities in each class.
        chance: ``(2, C)`` probabilities of both classes of good closures.
    """
    good, shape = slice(GOOD), said.scale.shape
    shaped = said.scale.floor_share / shape.size
    total, share = said.total[good], (chance * said.variance[good] * shaped)[:, :, None]
    axes = np.matmul(np.matmul(shape.frame.transpose(0, 2, 1), shape.even), said.axes)
    pulled = np.matmul(axes, (np.sqrt(share) * said.along[good] / total)[:, :, :, None])[:, :, :, 0]
    pulled = pulled.reshape(-1, pulled.shape[2])
    expected = (share / total).sum(axis=0)[:, None, :]
    return np.stack((pulled.T @ pulled, np.matmul(axes * expected, axes.transpose(0, 2, 1)).sum(axis=0)))


def _of_turns(said: Said, chance: np.ndarray) -> tuple[np.ndarray, float, float]:
    """``(C,)`` rad⁻², weights of turns likewise; squares and freedom of good closures for their noise's variance."""
    k, (variance, nearly) = said.turns, said.turned
    right, alike = chance[:GOOD].sum(axis=0), chance[GOOD:-1].sum(axis=0)
    spread = np.trace(said.predictions.covariance[:, :k, :k], axis1=1, axis2=2) / k
    pull = right / (variance + spread) + alike / (nearly + spread)
    shrunk = right / (1 + spread / variance) + alike / (1 + spread / nearly) + chance[-1]
    square, total = (said.predictions.mean[:, :k] ** 2).sum(axis=1), variance + spread
    weight = np.maximum(pull / shrunk, NOTHING / variance)
    return weight, float((right * square * variance / total**2).sum()), float((right * k * variance / total).sum())


def _least_weight(square: np.ndarray, scale: Scale) -> np.ndarray:
    """``(C,)`` m⁻², negligible weight of closures with squared residuals ``square``, m², however large."""
    return np.asarray(NOTHING / (scale.closure + square))
