"""Factorisation and solution of unsymmetric banded systems.

A matrix A of half-bandwidth 8 is held by rows: ``matrix[i, 8 + j - i] = A[i, j]``, shape
(n_dofs, 17). Only rows and columns ``first <= i < last`` take part; the others are the rod's
prescribed degrees of freedom and keep their coupling entries untouched.
"""

from numba import njit

from dlo_gym.rod._kernels_banded import HALF_BANDWIDTH


@njit(cache=True)
def expand(band, matrix):
    """Update ``matrix`` (n_dofs, 17) with the symmetric matrix of lower ``band`` (n_dofs, 9)."""
    n = band.shape[0]
    matrix[:] = 0.0
    for j in range(n):
        matrix[j, HALF_BANDWIDTH] = band[j, 0]
        for k in range(1, min(HALF_BANDWIDTH, n - 1 - j) + 1):
            matrix[j, HALF_BANDWIDTH + k] = band[j, k]
            matrix[j + k, HALF_BANDWIDTH - k] = band[j, k]


@njit(cache=True)
def factorise(matrix, first, last):
    """Update ``matrix`` to the factors of A = L U, without pivoting; returns the number of
    negative pivots: that of A's negative eigenvalues where A is symmetric."""
    negative = 0
    for k in range(first, last):
        pivot = matrix[k, HALF_BANDWIDTH]
        if pivot <= 0.0:
            negative += 1
            if pivot == 0.0:
                pivot = matrix[k, HALF_BANDWIDTH] = 1e-300
        reach = min(HALF_BANDWIDTH, last - 1 - k)
        for m in range(1, reach + 1):
            factor = matrix[k + m, HALF_BANDWIDTH - m] / pivot
            matrix[k + m, HALF_BANDWIDTH - m] = factor
            for c in range(1, reach + 1):
                matrix[k + m, HALF_BANDWIDTH - m + c] -= factor * matrix[k, HALF_BANDWIDTH + c]
    return negative


@njit(cache=True)
def solve(matrix, first, last, columns):
    """Update ``columns`` (n_dofs, m) to A^-1 columns, given the factors of A."""
    width = columns.shape[1]
    for i in range(first, last):
        for k in range(1, min(HALF_BANDWIDTH, i - first) + 1):
            factor = matrix[i, HALF_BANDWIDTH - k]
            for c in range(width):
                columns[i, c] -= factor * columns[i - k, c]
    for i in range(last - 1, first - 1, -1):
        for k in range(1, min(HALF_BANDWIDTH, last - 1 - i) + 1):
            factor = matrix[i, HALF_BANDWIDTH + k]
            for c in range(width):
                columns[i, c] -= factor * columns[i + k, c]
        inverse = 1.0 / matrix[i, HALF_BANDWIDTH]
        for c in range(width):
            columns[i, c] *= inverse


@njit(cache=True)
def multiply_coupling(matrix, first, last, prescribed, out):
    """Update ``out`` (n_dofs, m): subtract A_free,prescribed times ``prescribed`` (n_dofs, m)."""
    n, width = out.shape
    for i in range(first, last):
        for j in range(max(0, i - HALF_BANDWIDTH), min(n, i + HALF_BANDWIDTH + 1)):
            if first <= j < last:
                continue
            for c in range(width):
                out[i, c] -= matrix[i, HALF_BANDWIDTH + j - i] * prescribed[j, c]
