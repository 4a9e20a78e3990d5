"""Loops over rows of three blocks: products with J and its transpose, and covariances of rows by H⁻¹.

Everywhere J is ``(E, d, 3 d)``. ``place`` ``(E, 3)`` is the block of each third of a row, in the order of elimination;
-1: none. ``slot`` ``(E, 3, 3)`` is where H's d² entries of a pair of a row's blocks begin, or -1. A pair has the same
entries in either order; their rows are those of the block that is eliminated first.
"""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled


@compiled
def normal_matrix(jacobian: np.ndarray, place: np.ndarray, slot: np.ndarray, num_entries: int) -> np.ndarray:
    """H = Jᵀ J, ``(num_entries,)``."""
    d = jacobian.shape[1]
    entries = np.zeros(num_entries)
    for e in range(len(jacobian)):
        row = jacobian[e]
        for a in range(3):
            for b in range(3):
                if place[e, a] < 0 or place[e, a] > place[e, b]:
                    continue
                at = slot[e, a, b]
                for i in range(d):
                    for j in range(d):
                        total = 0.0
                        for c in range(d):
                            total += row[c, a * d + i] * row[c, b * d + j]
                        entries[at] += total
                        at += 1
    return entries


@compiled
def gradient(jacobian: np.ndarray, place: np.ndarray, rows: np.ndarray, num_blocks: int) -> np.ndarray:
    """``(blocks, d, n)`` Jᵀ times rows ``(E, d, n)``."""
    num_rows, d, count = rows.shape
    found = np.zeros((num_blocks, d, count))
    for e in range(num_rows):
        for a in range(3):
            if place[e, a] < 0:
                continue
            to = found[place[e, a]]
            for c in range(d):
                for i in range(d):
                    factor = jacobian[e, c, a * d + i]
                    if factor != 0.0:
                        for n in range(count):
                            to[i, n] += factor * rows[e, c, n]
    return found


@compiled
def predicted_rows(jacobian: np.ndarray, place: np.ndarray, unknowns: np.ndarray) -> np.ndarray:
    """``(E, d, n)`` J times unknowns ``(blocks, d, n)``."""
    num_rows, d, _ = jacobian.shape
    count = unknowns.shape[2]
    found = np.zeros((num_rows, d, count))
    for e in range(num_rows):
        for a in range(3):
            if place[e, a] < 0:
                continue
            of = unknowns[place[e, a]]
            for c in range(d):
                for i in range(d):
                    factor = jacobian[e, c, a * d + i]
                    if factor != 0.0:
                        for n in range(count):
                            found[e, c, n] += factor * of[i, n]
    return found


@compiled
def covariance_of_rows(jacobian: np.ndarray, place: np.ndarray, slot: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """``(E, d, d)`` J H⁻¹ Jᵀ of each row, from H⁻¹ at H's entries; of diagonal blocks the upper triangle is read."""
    num_rows, d, _ = jacobian.shape
    found = np.zeros((num_rows, d, d))
    half = np.empty((d, d))
    for e in range(num_rows):
        row = jacobian[e]
        for a in range(3):
            if place[e, a] < 0:
                continue
            # Z Jᵀ of the row's block a.
            half[:] = 0.0
            for b in range(3):
                if place[e, b] < 0:
                    continue
                at = slot[e, a, b]
                for i in range(d):
                    for j in range(d):
                        is_upright = i <= j if a == b else place[e, a] < place[e, b]
                        value = inverse[at + (i * d + j if is_upright else j * d + i)]
                        for c in range(d):
                            half[i, c] += value * row[c, b * d + j]
            for c in range(d):
                for i in range(d):
                    factor = row[c, a * d + i]
                    if factor != 0.0:
                        for k in range(d):
                            found[e, c, k] += factor * half[i, k]
        for c in range(d):
            for k in range(c):
                found[e, c, k] = found[e, k, c] = (found[e, c, k] + found[e, k, c]) / 2
    return found


@compiled
def exceed(matrices: np.ndarray, least: float) -> np.ndarray:
    """``(n,)`` bool, whether symmetric matrices ``(n, d, d)`` less ``least`` on the diagonal are positive definite."""
    count, d, _ = matrices.shape
    found = np.empty(count, np.bool_)
    lower, pivot = np.empty((d, d)), np.empty(d)
    for n in range(count):
        is_definite = True
        for k in range(d):
            for i in range(k, d):
                value = matrices[n, i, k] - (least if i == k else 0.0)
                for j in range(k):
                    value -= lower[i, j] * lower[k, j] * pivot[j]
                if i == k:
                    is_definite &= value > 0.0
                    pivot[k] = value
                else:
                    lower[i, k] = value / pivot[k]
        found[n] = is_definite
    return found
