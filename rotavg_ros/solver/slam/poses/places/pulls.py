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
    constant, along_body, pulled = _of_parts(said, chance[:GOOD] * known)
    return Places(
        chance,
        np.maximum(weight, _least_weight(square, said.scale)),
        turn_weight,
        np.array([turn_squares, constant[0]]),
        np.array([turn_freedom, constant[1]]),
        log_density,
        *said.errors(),
        said.scale.shape.even,
        along_body,
        pulled,
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
    zeros, even = (np.zeros(2), np.zeros(2), np.zeros(len(is_good))), scale.shape.even
    nothing = np.zeros((2, *even.shape[1:])), np.zeros((2, len(is_good)))
    return Places(chance, _least_weight(square, scale), turn, *zeros, none, none, even, *nothing)


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


def _of_parts(said: Said, chance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squares and freedom of good closures' errors, given the probabilities ``(2, C)`` of their classes.

    Returns:
        ``(2,)`` of the constant part; ``(2, m, m)`` of this along the body's axes; ``(2, C)`` of each closure's whole
        error, divided by its squared variance and by its variance.
    """
    scale, good = said.scale, slice(GOOD)
    shape, total, weight = scale.shape, said.total[good], chance * said.variance[good] / scale.own
    axes = np.matmul(shape.even, said.axes)
    # Inverse covariances times shifts, and the inverses, weighted by classes.
    pulled = np.matmul(axes, (np.sqrt(weight)[:, :, None] * said.along[good] / total)[:, :, :, None])[:, :, :, 0]
    inverse = np.matmul(axes * (weight[:, :, None] / total).sum(axis=0)[:, None, :], axes.transpose(0, 2, 1))
    constant = scale.own / shape.size * scale.floor_share
    in_body = np.matmul(shape.frame.transpose(0, 2, 1), (np.sqrt(constant)[:, None] * pulled)[:, :, :, None])[
        :, :, :, 0
    ]
    in_body = in_body.reshape(-1, in_body.shape[2])
    expected = np.matmul(np.matmul(shape.frame.transpose(0, 2, 1), constant[:, None, None] * inverse), shape.frame)
    along_body = np.stack((in_body.T @ in_body, expected.sum(axis=0)))
    of_each = np.stack((over_components(pulled**2).sum(axis=0), np.trace(inverse, axis1=1, axis2=2)))
    return (along_body * shape.shape).sum(axis=(1, 2)), along_body, of_each


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
