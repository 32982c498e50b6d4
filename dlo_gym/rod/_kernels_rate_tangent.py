"""How the strains' rates and the accelerations change with shape and motion, m columns at once."""

import numpy as np
from numba import njit

from dlo_gym.rod._kernels_energy import log_factor, relative_quaternion
from dlo_gym.rod._kernels_parameters import EXTERNAL_DAMPING, LENGTH, LOG_WEIGHT
from dlo_gym.rod._kernels_tangent import neighbours


@njit(cache=True)
def mass_change(code, length):
    """d(log mass) of a column."""
    return 1.0 if code == LOG_WEIGHT else 1.0 / length if code == LENGTH else 0.0


@njit(cache=True)
def _turn_of_bend_rate(q, a, b, out):
    """Update ``out`` (2, 3, 3) with d(D d kappa/dt)/d(turn) of the frames before and after, given
    their relative quaternion (4,) and spins a and b (3,)."""
    r, s = q[0], q[1:]
    g, dg, ddg = log_factor(r)
    dr = 0.5 * ((a[0] - b[0]) * s[0] + (a[1] - b[1]) * s[1] + (a[2] - b[2]) * s[2])
    ds, vr, vs = np.empty(3), 0.0, np.empty(3)
    for k in range(3):
        j, m = (k + 1) % 3, (k + 2) % 3
        ds[k] = 0.5 * (r * (b[k] - a[k]) + s[j] * (a[m] + b[m]) - s[m] * (a[j] + b[j]))
    for side in range(2):
        sign = 0.5 if side == 0 else -0.5
        for t in range(3):
            # The quaternion's change (vr, vs) with the turn, and that of its rate
            vr = sign * s[t]
            vs[t] = -sign * r
            vs[(t + 1) % 3] = 0.5 * s[(t + 2) % 3]
            vs[(t + 2) % 3] = -0.5 * s[(t + 1) % 3]
            ddr = 0.5 * ((a[0] - b[0]) * vs[0] + (a[1] - b[1]) * vs[1] + (a[2] - b[2]) * vs[2])
            for k in range(3):
                j, m = (k + 1) % 3, (k + 2) % 3
                dds = 0.5 * (vr * (b[k] - a[k]) + vs[j] * (a[m] + b[m]) - vs[m] * (a[j] + b[j]))
                out[side, k, t] = (
                    ddg * vr * dr * s[k] + dg * (ddr * s[k] + dr * vs[k] + vr * ds[k]) + g * dds
                )


@njit(cache=True)
def change_rates(rod, geometry, ends, q, v, w, spin, rate, codes, tangent, d_spin, out):
    """Update ``out`` (2 n + 1, 3, m) with the change of ``rate`` (2 n + 1, 3): ``strain_rates``.

    ``spin`` (2, 3) and ``d_spin`` (2, 3, m) are of the clamps, in their own frames.
    """
    R, span, bend = geometry.R, geometry.span, geometry.bend
    unknowns, speeds, d_w = tangent.unknowns, tangent.speeds, tangent.w
    n, m = w.shape[0], d_w.shape[2]
    before, after = np.empty((3, m)), np.empty((3, m))
    relative, turned, u = np.empty(4), np.empty((2, 3, 3)), np.empty(3)
    for e in range(n):
        scale, base = 1.0 / rod.rest_length[e], 6 * e
        for i in range(3):
            u[i] = 0.0
            for k in range(3):
                u[i] += R[e, k, i] * (v[e + 1, k] - v[e, k])
        p0, p1, p2 = span[e, 0], span[e, 1], span[e, 2]
        w0, w1, w2 = w[e, 0], w[e, 1], w[e, 2]
        along = w0 * p0 + w1 * p1 + w2 * p2
        p, spun = (p0, p1, p2), (w0, w1, w2)
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            r0, r1, r2 = R[e, 0, i], R[e, 1, i], R[e, 2, i]
            rj0, rj1, rj2 = R[e, 0, j], R[e, 1, j], R[e, 2, j]
            rk0, rk1, rk2 = R[e, 0, k], R[e, 1, k], R[e, 2, k]
            wj, wk, pi, pj, pk, uj, uk = spun[j], spun[k], p[i], p[j], p[k], u[j], u[k]
            for c in range(m):
                x0 = unknowns[base + 6, c] - unknowns[base, c]
                x1 = unknowns[base + 7, c] - unknowns[base + 1, c]
                x2 = unknowns[base + 8, c] - unknowns[base + 2, c]
                ti = unknowns[base + 3 + i, c]
                tj, tk = unknowns[base + 3 + j, c], unknowns[base + 3 + k, c]
                turn = (
                    w0 * unknowns[base + 3, c]
                    + w1 * unknowns[base + 4, c]
                    + w2 * unknowns[base + 5, c]
                )
                # R^T dv' + u x t + (R^T dx') x w + (p x t) x w + p x dw
                out[e, i, c] = scale * (
                    r0 * (speeds[e + 1, 0, c] - speeds[e, 0, c])
                    + r1 * (speeds[e + 1, 1, c] - speeds[e, 1, c])
                    + r2 * (speeds[e + 1, 2, c] - speeds[e, 2, c])
                    + uj * tk - uk * tj
                    + (rj0 * x0 + rj1 * x1 + rj2 * x2) * wk
                    - (rk0 * x0 + rk1 * x1 + rk2 * x2) * wj
                    + along * ti - turn * pi
                    + pj * d_w[e, k, c] - pk * d_w[e, j, c]
                )  # fmt: skip
    out[2 * n] = 0.0
    for i in range(n + 1 if ends.right_held else n):
        relative_quaternion(
            ends.frames[0] if i == 0 else q[i - 1], ends.frames[1] if i == n else q[i], relative
        )
        _turn_of_bend_rate(
            relative, spin[0] if i == 0 else w[i - 1], spin[1] if i == n else w[i], turned
        )
        neighbours(tangent, i, n, before, after)
        spun_before = d_spin[0] if i == 0 else d_w[i - 1]
        spun_after = d_spin[1] if i == n else d_w[i]
        scale = 1.0 / rod.voronoi_length[i]
        for k in range(3):
            a, b = bend[i, 0, k], bend[i, 1, k]
            ta, tb = turned[0, k], turned[1, k]
            for c in range(m):
                out[n + i, k, c] = scale * (
                    a[0] * spun_before[0, c] + a[1] * spun_before[1, c] + a[2] * spun_before[2, c]
                    + b[0] * spun_after[0, c] + b[1] * spun_after[1, c] + b[2] * spun_after[2, c]
                    + ta[0] * before[0, c] + ta[1] * before[1, c] + ta[2] * before[2, c]
                    + tb[0] * after[0, c] + tb[1] * after[1, c] + tb[2] * after[2, c]
                )  # fmt: skip
    length = rod.rest_length.sum()
    for c in range(m):
        if codes[c] == LENGTH:
            for i in range(2 * n + 1):
                for k in range(3):
                    out[i, k, c] -= rate[i, k] / length


@njit(cache=True)
def change_accelerations(motion, R, w, speeds, gradient, codes, length, tangent, d_gradient, out):
    """Update ``out`` (3 n + 1, 3, m) with the change of ``accelerations``, given that of their
    gradient (6 n + 3, m)."""
    n, m = w.shape[0], out.shape[2]
    damping = motion.external
    unknowns, d_speeds, d_w = tangent.unknowns, tangent.speeds, tangent.w
    heavier, damped = np.empty(m), np.empty(m)
    for c in range(m):
        heavier[c] = mass_change(codes[c], length)
        damped[c] = 1.0 if codes[c] == EXTERNAL_DAMPING else 0.0
    for i in range(n + 1):
        inverse = 1.0 / motion.mass[i]
        for k in range(3):
            force, speed = gradient[6 * i + k], speeds[i, k]
            for c in range(m):
                out[i, k, c] = (
                    inverse * (force * heavier[c] - d_gradient[6 * i + k, c])
                    - damping * d_speeds[i, k, c]
                    - speed * damped[c]
                )
    y, z = np.empty((3, m)), np.empty((3, m))
    for e in range(n):
        row, theta = n + 1 + 2 * e, 6 * e + 3
        inverse = 1.0 / motion.mass[row]
        g0, g1, g2 = inverse * gradient[theta], inverse * gradient[theta + 1], 0.0
        g2 = 0.5 * inverse * gradient[theta + 2]
        w0, w1, w2 = w[e, 0], w[e, 1], w[e, 2]
        a0 = -g0 - w1 * w2 - damping * w0
        a1 = -g1 + w0 * w2 - damping * w1
        a2 = -g2 - damping * w2
        # Accelerations of d1 and d2 in the element's frame
        y0, y1, y2 = -w1 * w1 - w2 * w2, a2 + w0 * w1, w0 * w2 - a1
        z0, z1, z2 = w0 * w1 - a2, -w0 * w0 - w2 * w2, a0 + w1 * w2
        for c in range(m):
            t0, t1, t2 = unknowns[theta, c], unknowns[theta + 1, c], unknowns[theta + 2, c]
            u0, u1, u2 = d_w[e, 0, c], d_w[e, 1, c], d_w[e, 2, c]
            h, s = heavier[c], damped[c]
            b0 = g0 * h - inverse * d_gradient[theta, c] - u1 * w2 - w1 * u2
            b1 = g1 * h - inverse * d_gradient[theta + 1, c] + u0 * w2 + w0 * u2
            b2 = g2 * h - 0.5 * inverse * d_gradient[theta + 2, c]
            b0 -= damping * u0 + s * w0
            b1 -= damping * u1 + s * w1
            b2 -= damping * u2 + s * w2
            y[0, c] = -2.0 * (w1 * u1 + w2 * u2) + t1 * y2 - t2 * y1
            y[1, c] = b2 + u0 * w1 + w0 * u1 + t2 * y0 - t0 * y2
            y[2, c] = u0 * w2 + w0 * u2 - b1 + t0 * y1 - t1 * y0
            z[0, c] = u0 * w1 + w0 * u1 - b2 + t1 * z2 - t2 * z1
            z[1, c] = -2.0 * (w0 * u0 + w2 * u2) + t2 * z0 - t0 * z2
            z[2, c] = b0 + u1 * w2 + w1 * u2 + t0 * z1 - t1 * z0
        for k in range(3):
            d1, d2, d3 = R[e, k, 0], R[e, k, 1], R[e, k, 2]
            for c in range(m):
                out[row, k, c] = d1 * y[0, c] + d2 * y[1, c] + d3 * y[2, c]
                out[row + 1, k, c] = d1 * z[0, c] + d2 * z[1, c] + d3 * z[2, c]
