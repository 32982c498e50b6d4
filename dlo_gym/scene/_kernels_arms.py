"""UR5e kinematics and the distances between arms, one after another over a batch."""

from math import acos, atan2, cos, fabs, hypot, nan, pi, sin, sqrt

import numpy as np
from numba import njit

# Denavit-Hartenberg parameters of the UR5e (Universal Robots, public table) [m], [rad].
DH_A = np.array([0.0, -0.425, -0.3922, 0.0, 0.0, 0.0])
DH_D = np.array([0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996])
DH_ALPHA = np.array([pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0])
JOINT_LIMIT = 2.0 * pi  # every joint turns +-360 degrees


@njit(cache=True)
def link_frames(joint_angles, frames):
    """Update ``frames`` (b, 7, 4, 4) with DH frames 0 to 6 at joint angles (b, 6) [rad]."""
    frames[:] = 0.0
    for b in range(len(joint_angles)):
        for k in range(4):
            frames[b, 0, k, k] = 1.0
        for i in range(6):
            c, s = cos(joint_angles[b, i]), sin(joint_angles[b, i])
            ca, sa = cos(DH_ALPHA[i]), sin(DH_ALPHA[i])
            before, after = frames[b, i], frames[b, i + 1]
            for k in range(3):
                x, y, z = before[k, 0], before[k, 1], before[k, 2]
                after[k, 0] = c * x + s * y
                across = c * y - s * x
                after[k, 1] = ca * across + sa * z
                after[k, 2] = ca * z - sa * across
                after[k, 3] = before[k, 3] + DH_A[i] * after[k, 0] + DH_D[i] * z
            after[3, 3] = 1.0


@njit(cache=True)
def wrist_branch(T, wrist_3, shoulder, flip):
    """Joints 1, 5 and 6 [rad] of one solution for the flange pose ``T`` (4, 4), and what is left
    for 2, 3 and 4: the first wrist joint (2) [m] in the plane of upper arm and forearm, and
    the joints' sum [rad].

    ``shoulder`` and ``flip`` are 1 or -1; NaN where the solution does not exist.
    """
    d4, d5, d6 = DH_D[3], DH_D[4], DH_D[5]
    x, y = T[0, 3], T[1, 3]
    wrist_x, wrist_y = x - d6 * T[0, 2], y - d6 * T[1, 2]
    reach = hypot(wrist_x, wrist_y)
    q1 = atan2(wrist_y, wrist_x) + pi / 2
    q1 += shoulder * (_arccos(d4 / reach) if reach > 0.0 else nan)
    s1, c1 = sin(q1), cos(q1)
    q5 = flip * _arccos((x * s1 - y * c1 - d4) / d6)
    s5, c5 = sin(q5), cos(q5)
    q6 = wrist_3
    if not fabs(s5) < 1e-7:
        sign = 1.0 if s5 > 0.0 else -1.0
        q6 = atan2(sign * (T[1, 1] * c1 - T[0, 1] * s1), sign * (T[0, 0] * s1 - T[1, 0] * c1))
    s6, c6 = sin(q6), cos(q6)
    # Rows x and y of T_1_6, and of them the first wrist joint and d1 of frame 4.
    px = c1 * x + s1 * y
    py = T[2, 3] - DH_D[0]
    e0, e1, turn_x, turn_y = s6 * d5, c6 * d5, 0.0, 0.0
    for k in range(3):
        row_x, row_y = c1 * T[0, k] + s1 * T[1, k], T[2, k]
        offset = e0 if k == 0 else (e1 if k == 1 else -d6)
        axis = s5 * c6 if k == 0 else (-s5 * s6 if k == 1 else c5)
        px += row_x * (offset - d4 * axis)
        py += row_y * (offset - d4 * axis)
        along = c5 * c6 if k == 0 else (-c5 * s6 if k == 1 else -s5)
        turn_x += row_x * along
        turn_y += row_y * along
    return q1, q5, q6, px, py, atan2(turn_y, turn_x)


@njit(cache=True)
def _arccos(cosine):
    """arccos, NaN out of range; a cosine that rounding took past +-1 is set back to it."""
    if fabs(cosine) > 1.0:
        return (0.0 if cosine > 0.0 else pi) if fabs(cosine) < 1.0 + 1e-9 else nan
    return acos(cosine)


@njit(cache=True)
def ik_branches(T_base_flange, wrist_3, branches):
    """Update ``branches`` (b, 8, 6) [rad] with all solutions for flange poses (b, 4, 4).

    Hawkins 2013, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms".
    """
    a2, a3 = DH_A[1], DH_A[2]
    for b in range(len(T_base_flange)):
        for pair in range(4):
            shoulder, flip = 1.0 - 2.0 * (pair // 2), 1.0 - 2.0 * (pair % 2)
            q1, q5, q6, px, py, turn = wrist_branch(T_base_flange[b], wrist_3[b], shoulder, flip)
            bend = _arccos((px * px + py * py - a2 * a2 - a3 * a3) / (2.0 * a2 * a3))
            for elbow in range(2):
                q3 = bend if elbow == 0 else -bend
                q2 = atan2(py, px) - atan2(a3 * sin(q3), a2 + a3 * cos(q3))
                q = branches[b, 2 * pair + elbow]
                q[0], q[1], q[2], q[3], q[4], q[5] = q1, q2, q3, turn - q2 - q3, q5, q6
                exists = q1 + q2 + q3 + q5 + q6
                for j in range(6):
                    q[j] = pi - (pi - q[j]) % (2.0 * pi) if exists == exists else nan


@njit(cache=True)
def nearest_solution(T_base_flange, guess, joint_angles):
    """Update ``joint_angles`` (b, 6) with the solutions nearest to ``guess`` (b, 6) [rad]."""
    branches = np.empty((1, 8, 6))
    for b in range(len(T_base_flange)):
        ik_branches(T_base_flange[b : b + 1], guess[b : b + 1, 5], branches)
        nearest = np.inf
        joint_angles[b] = nan
        for q in branches[0]:
            away = 0.0
            for j in range(6):
                q[j] = nearest_turn(q[j], guess[b, j])
                away += (q[j] - guess[b, j]) ** 2
            if away < nearest:
                nearest = away
                joint_angles[b] = q


@njit(cache=True)
def follow_solutions(T_base_flange, guess, joint_angles):
    """Update ``joint_angles`` (s, 2, 6) with solutions for flange poses (s, k, 4, 4) of the first k
    arms along a way, each nearest to the last one there was, the first to ``guess`` (2, 6) [rad].
    """
    last = guess.copy()
    for s in range(len(T_base_flange)):
        joint_angles[s] = last
        nearest_solution(T_base_flange[s], last, joint_angles[s])
        for side in range(2):
            if joint_angles[s, side, 0] == joint_angles[s, side, 0]:
                last[side] = joint_angles[s, side]


@njit(cache=True)
def nearest_turn(angle, guess):
    """``angle`` by whole turns as close to ``guess`` as the joint limits allow [rad]."""
    turned = angle + 2.0 * pi * np.rint((guess - angle) / (2.0 * pi))
    if turned > JOINT_LIMIT:
        return turned - 2.0 * pi
    return turned + 2.0 * pi if turned < -JOINT_LIMIT else turned


@njit(cache=True)
def capsule_axes(T_world_base, joint_angles, links, ends, axes):
    """Update ``axes`` (b, 2, n, 2, 3) [m] with the capsules' axes at joint angles (b, 2, 6) [rad].

    The n capsules have ``ends`` (n, 2, 3) [m] in the frames ``links`` (n,) of arms on bases
    (2, 4, 4).
    """
    frames = np.empty((2, 7, 4, 4))
    for b in range(len(joint_angles)):
        link_frames(joint_angles[b], frames)
        for side in range(2):
            base = T_world_base[side]
            for c in range(len(links)):
                frame = frames[side, links[c]]
                for end in range(2):
                    p0, p1, p2 = ends[c, end, 0], ends[c, end, 1], ends[c, end, 2]
                    x = frame[0, 0] * p0 + frame[0, 1] * p1 + frame[0, 2] * p2 + frame[0, 3]
                    y = frame[1, 0] * p0 + frame[1, 1] * p1 + frame[1, 2] * p2 + frame[1, 3]
                    z = frame[2, 0] * p0 + frame[2, 1] * p1 + frame[2, 2] * p2 + frame[2, 3]
                    for k in range(3):
                        axes[b, side, c, end, k] = (
                            base[k, 0] * x + base[k, 1] * y + base[k, 2] * z + base[k, 3]
                        )


@njit(cache=True)
def clearances(axes, radii, above_table, pairs, between, table, within):
    """Update the smallest distances [m] of capsules with ``axes`` (b, 2, n, 2, 3), ``radii`` (n,):
    ``between`` (b,) the arms, to the ``table`` (b, 2), and ``within`` (b, 2) each arm over
    ``pairs`` (m, 2) of its capsules.

    Pairs whose enclosing spheres are further apart than the smallest gap so far are left out.
    """
    n = len(radii)
    spheres = np.empty((2, n, 4))
    for b in range(len(axes)):
        for side in range(2):
            for i in range(n):
                _enclose(axes[b, side, i], radii[i], spheres[side, i])
        between[b] = np.inf
        for i in range(n - 1, -1, -1):  # the grippers first: they are the nearest as a rule
            for j in range(n - 1, -1, -1):
                if not _apart(spheres[0, i], spheres[1, j], between[b]):
                    gap = segment_distance(axes[b, 0, i], axes[b, 1, j]) - (radii[i] + radii[j])
                    between[b] = min(between[b], gap)
        for side in range(2):
            table[b, side] = within[b, side] = np.inf
            for i in range(n):
                if above_table[i]:
                    lowest = min(axes[b, side, i, 0, 2], axes[b, side, i, 1, 2])
                    table[b, side] = min(table[b, side], lowest - radii[i])
            for m in range(len(pairs)):
                i, j = pairs[m]
                if not _apart(spheres[side, i], spheres[side, j], within[b, side]):
                    gap = segment_distance(axes[b, side, i], axes[b, side, j])
                    within[b, side] = min(within[b, side], gap - radii[i] - radii[j])


@njit(cache=True)
def _enclose(axis, radius, sphere):
    """Update ``sphere`` (4,), centre and radius [m], to hold a capsule with ``axis`` (2, 3)."""
    squared = 0.0
    for k in range(3):
        sphere[k] = 0.5 * (axis[0, k] + axis[1, k])
        squared += (axis[1, k] - axis[0, k]) ** 2
    sphere[3] = 0.5 * sqrt(squared) + radius


@njit(cache=True)
def _apart(first, second, gap):
    """Whether two spheres (4,) are further apart than ``gap`` [m]."""
    reach = first[3] + second[3] + gap
    squared = (first[0] - second[0]) ** 2 + (first[1] - second[1]) ** 2
    return reach >= 0.0 and squared + (first[2] - second[2]) ** 2 > reach * reach


@njit(cache=True)
def segment_distances(first, second, distances):
    """Update ``distances`` (b,) [m] between segments (b, 2, 3)."""
    for b in range(len(first)):
        distances[b] = segment_distance(first[b], second[b])


@njit(cache=True)
def segment_distance(first, second):
    """Between segments (2, 3), given by their ends (Ericson, Real-Time Collision Detection,
    5.1.9)."""
    a, e, b, c, f = 1e-15, 1e-15, 0.0, 0.0, 0.0
    for k in range(3):
        d1, d2 = first[1, k] - first[0, k], second[1, k] - second[0, k]
        r = first[0, k] - second[0, k]
        a += d1 * d1
        e += d2 * d2
        b += d1 * d2
        c += d1 * r
        f += d2 * r
    s = _unit((b * f - c * e) / max(a * e - b * b, 1e-15))
    t = _unit((b * s + f) / e)
    s = _unit((b * t - c) / a)
    squared = 0.0
    for k in range(3):
        on_first = first[0, k] + s * (first[1, k] - first[0, k])
        on_second = second[0, k] + t * (second[1, k] - second[0, k])
        squared += (on_first - on_second) ** 2
    return sqrt(squared)


@njit(cache=True)
def _unit(value):
    return min(max(value, 0.0), 1.0)
