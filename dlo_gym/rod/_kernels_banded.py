"""Factorisation and solution of symmetric banded systems.

A symmetric matrix H of half-bandwidth 8 is held by its lower band: ``band[j, k] = H[j + k, j]``,
shape (n_dofs, 9). Only rows and columns ``first <= i < last`` take part; the others are the
rod's prescribed degrees of freedom and keep their coupling columns untouched.
"""

from numba import njit

HALF_BANDWIDTH = 8


@njit(cache=True)
def factorise(band, first, last):
    """Update ``band`` to the factors of H = L D L^T; returns the number of negative pivots.

    D stands in ``band[:, 0]``, the unit lower triangle's columns in ``band[:, 1:]``. The number of
    negative pivots is that of H's negative eigenvalues (Sylvester's law of inertia).
    """
    negative = 0
    for j in range(first, last):
        pivot = band[j, 0]
        if pivot <= 0.0:
            negative += 1
            if pivot == 0.0:
                pivot = band[j, 0] = 1e-300
        inverse = 1.0 / pivot
        if j + HALF_BANDWIDTH < last:  # of fixed size, so that the compiler unrolls it
            for k in range(1, HALF_BANDWIDTH + 1):
                factor = band[j, k] * inverse
                for m in range(k, HALF_BANDWIDTH + 1):
                    band[j + k, m - k] -= factor * band[j, m]
            for k in range(1, HALF_BANDWIDTH + 1):
                band[j, k] *= inverse
        else:
            reach = last - 1 - j
            for k in range(1, reach + 1):
                factor = band[j, k] * inverse
                for m in range(k, reach + 1):
                    band[j + k, m - k] -= factor * band[j, m]
            for k in range(1, reach + 1):
                band[j, k] *= inverse
    return negative


@njit(cache=True)
def solve_one(band, first, last, column):
    """Update ``column`` (n_dofs,) to H^-1 column, given the factors of H."""
    for j in range(first, last):
        value = column[j]
        if j + HALF_BANDWIDTH < last:
            for k in range(1, HALF_BANDWIDTH + 1):
                column[j + k] -= band[j, k] * value
        else:
            for k in range(1, last - j):
                column[j + k] -= band[j, k] * value
    for j in range(last - 1, first - 1, -1):
        near, far = column[j] / band[j, 0], 0.0
        if j + HALF_BANDWIDTH < last:
            for k in range(1, 5):
                near -= band[j, k] * column[j + k]
                far += band[j, k + 4] * column[j + k + 4]
        else:
            for k in range(1, last - j):
                near -= band[j, k] * column[j + k]
        column[j] = near - far


@njit(cache=True)
def solve(band, first, last, columns):
    """Update ``columns`` (n_dofs, m) to H^-1 columns, given the factors of H."""
    width = columns.shape[1]
    for j in range(first, last):
        for k in range(1, min(HALF_BANDWIDTH, last - 1 - j) + 1):
            factor = band[j, k]
            for c in range(width):
                columns[j + k, c] -= factor * columns[j, c]
    for j in range(last - 1, first - 1, -1):
        inverse = 1.0 / band[j, 0]
        for c in range(width):
            columns[j, c] *= inverse
        for k in range(1, min(HALF_BANDWIDTH, last - 1 - j) + 1):
            factor = band[j, k]
            for c in range(width):
                columns[j, c] -= factor * columns[j + k, c]


@njit(cache=True)
def multiply_coupling(band, first, last, prescribed, out):
    """Update ``out`` (n_dofs, m): subtract H_free,prescribed times ``prescribed`` (n_dofs, m).

    Reads the coupling entries that ``factorise`` leaves untouched: columns below ``first`` and
    rows from ``last`` on.
    """
    n_dofs, width = out.shape
    for j in range(first):
        for k in range(max(1, first - j), HALF_BANDWIDTH + 1):
            for c in range(width):
                out[j + k, c] -= band[j, k] * prescribed[j, c]
    for j in range(max(first, last - HALF_BANDWIDTH), last):
        for k in range(last - j, min(HALF_BANDWIDTH, n_dofs - 1 - j) + 1):
            for c in range(width):
                out[j, c] -= band[j, k] * prescribed[j + k, c]


@njit(cache=True)
def shift_diagonal(band, first, last, translation, rotation):
    """Update ``band``: add Levenberg's damping, one value for positions, one for rotations.

    Degrees of freedom alternate: three of a node's position, three of an element's rotation.
    """
    for j in range(first, last):
        band[j, 0] += translation if (j // 3) % 2 == 0 else rotation
