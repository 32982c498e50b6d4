"""One stage of an implicit time step as a potential: see ``_kernels_dynamics``."""

from math import sqrt

from numba import njit

from dlo_gym.rod._kernels_moment import combine, inelastic

GAMMA = 2.0 - sqrt(2.0)
BDF_NEW = 1.0 / (GAMMA * (2.0 - GAMMA))
BDF_OLD = (1.0 - GAMMA) ** 2 * BDF_NEW


@njit(cache=True)
def set_stage(rod, motion, s, base, ends, stage):
    """Update ``stage`` to springs and viscous stiffness; ``base`` holds b and c."""
    n = base.q.shape[0]
    damping = motion.external * s
    for i in range(3 * n + 1):
        stage.inertia.weight[i] = motion.mass[i] * (1.0 + damping) / s**2
    stage.inertia.weight[0] = 0.0  # the clamps carry the nodes they hold
    if ends.right_held:
        stage.inertia.weight[n] = 0.0
    # Where the damped, unloaded motion ends.
    combine(1.0, base.places, s / (1.0 + damping), base.speeds, stage.inertia.centre)
    if not inelastic(motion):
        return
    share = motion.internal / s
    combine(1.0 + share, rod.shear, 0.0, rod.shear, stage.rod.shear)
    shift = share / (1.0 + share)
    combine(1.0 - shift, rod.rest_strain, shift, base.strain, stage.rod.rest_strain)
    combine(share, rod.bending, 0.0, rod.bending, stage.rod.viscous)
    combine(1.0, base.strain[n:], 0.0, base.strain[n:], stage.rod.viscous_centre)
    # M = B (k - c k_v) for k = kappa - kappa0 - plastic, k_v = (b_v + a k) / (1 + a).
    a = s / motion.relaxation
    softer = 1.0 - motion.creep * a / (1.0 + a)
    crept = motion.creep / ((1.0 + a) * softer)
    combine(softer, rod.bending, 0.0, rod.bending, stage.rod.bending)
    combine(1.0, motion.rest_curvature, crept, base.creep, stage.rod.rest_curvature)
