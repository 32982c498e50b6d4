"""Quasi-static moves of a rod that touches something: those of ``_kernels_move``, with contact."""

from collections.abc import Sequence

import numpy as np

from dlo_gym.geometry.se3 import Array
from dlo_gym.rod import _kernels_move as kernels
from dlo_gym.rod._kernels_solve import CONVERGED
from dlo_gym.rod.contact import ContactModel
from dlo_gym.rod.obstacles import Obstacle, on_the_way
from dlo_gym.rod.plausibility import problem_of


def move(
    contact: ContactModel,
    held: kernels.Held,
    energy: float,
    twist: Array,
    descend: bool,
    obstacles: Sequence[Obstacle] | None,
) -> tuple[str, float, float]:
    """Move the clamps by ``twist`` (12,), the ``obstacles`` to other poses, and the rod with them.

    As the kernel of this name. Returns what is wrong, or "", the part of the move that was made or
    at which it was lost, and the energy stored [J].
    """
    before, contact_before, standing = kernels.kept_of(held), contact.save(), contact.obstacles
    energy_before = energy
    full_stride = 1.0 / kernels.substeps(twist, held.bounds)
    done, stride = 0.0, full_stride
    while done < 1.0:
        reached = done + stride if done + stride < 1.0 - 1e-9 else 1.0
        bodies = None if obstacles is None else on_the_way(standing, obstacles, reached)
        free = True
        if not descend:
            moved = (reached - done) * twist
            followed, stored = _substep(
                contact, held, energy, before.clamps, twist, reached, moved, bodies
            )
            if followed:
                done, energy = reached, stored
                continue
            stride *= 0.5
            if stride >= kernels.SMALLEST_SUBSTEP * full_stride:
                continue
            positions = held.x.copy()
            kernels.take_ends_along(held, before.clamps, twist, reached)
            free = contact.place(positions, held.x, bodies)
        problem, stored = _snap(contact, held) if free else ("an obstacle is in the way", 0.0)
        if problem:
            _give_back(contact, contact_before, before, held)
            return problem, reached, energy_before
        done, stride, energy = reached, full_stride, stored
    return "", 1.0, energy


def _shape(held: kernels.Held):
    return held.system, held.x, held.q, held.ends


def _substep(
    contact: ContactModel,
    held: kernels.Held,
    energy: float,
    start: Array,
    twist: Array,
    reached: float,
    moved: Array,
    obstacles: Sequence[Obstacle] | None,
) -> tuple[bool, float]:
    """Whether the equilibrium could be followed (if not, all is as before), and the energy."""
    kernels.flow(held)
    kept, contact_kept = kernels.kept_of(held), contact.save()
    right_held, wrenches = held.ends.right_held, np.empty((2, 12))
    kernels.clamp_wrenches(held.work, held.clamps, right_held, wrenches[0])
    kernels.displace_from(start, twist, reached, held)
    status, potential = contact.follow(
        _shape(held), moved, kept.clamps, obstacles, held.limits, held.work
    )
    if status == CONVERGED:
        kernels.clamp_wrenches(held.work, held.clamps, right_held, wrenches[1])
        # The clamps' work bounds the energy's rise; more means another branch was reached.
        work = float(moved @ wrenches.mean(axis=0))
        slack = abs(work) + 1e-3 * held.limits.torque
        bounded = obstacles is not None or potential - energy <= work + slack
        problem, stored = _judge(contact, held, potential)
        if bounded and not problem:
            return True, stored
    _give_back(contact, contact_kept, kept, held)
    return False, energy


def _snap(contact: ContactModel, held: kernels.Held) -> tuple[str, float]:
    """Descend from the present shape; what is wrong with the result, and the energy stored [J]."""
    status, steps = contact.minimise(_shape(held), held.limits, kernels.DESCENT, held.work)
    potential, _ = contact.linearise(_shape(held), held.work)
    if status != CONVERGED:
        return problem_of(status, steps, held.bounds), potential
    return _judge(contact, held, potential)


def _judge(contact: ContactModel, held: kernels.Held, potential: float) -> tuple[str, float]:
    status, measure, stored = kernels.judge(held, potential)
    problem = problem_of(status, measure, held.bounds)
    return problem or contact.problem(held.x), stored


def _give_back(contact: ContactModel, contact_kept, kept: kernels.Kept, held: kernels.Held) -> None:
    kernels.give_back(kept, held)
    contact.load(contact_kept)
    contact.linearise(_shape(held), held.work)
