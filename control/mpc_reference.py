"""The MPC's problem as a nonlinear program for IPOPT: the reference the fast solver is held to."""

import casadi as ca
import numpy as np

from control.problem import Plan, ShapeProblem
from dlo_gym.exceptions import SolverFailed
from dlo_gym.geometry.se3 import Array


def solve_with_ipopt(
    problem: ShapeProblem, step: ca.Function, start: Array, *, max_iterations: int = 300
) -> Plan:
    """The optimal plan by single shooting, with the exact distance limits.

    Seconds rather than milliseconds: for tests and for judging the real-time iteration.

    Args:
        problem: one control step's problem.
        step: (3 n_nodes, 12) -> 3 n_nodes, a model as ``casadi_surrogate.casadi_step`` makes it.
        start: (N, 10) plan to start from.
        max_iterations: of IPOPT.

    Raises:
        SolverFailed: if IPOPT finds no solution.
    """
    N, m = start.shape
    plan = ca.MX.sym("plan", N * m)
    directions, disturbance = problem.directions, problem.disturbance.ravel()
    shape, shapes = ca.MX(ca.DM(problem.centerline.ravel())), []
    for k in range(N):
        shape = step(shape, directions @ plan[m * k : m * (k + 1)]) + disturbance
        shapes.append(shape)
    errors = ca.vertcat(*shapes) - np.tile(problem.goal.ravel(), N)
    cost = ca.dot(problem.shape_weights.ravel() * errors, errors)
    cost += 0.5 * ca.bilin(ca.DM(problem.decision_hessian), plan)
    cost += ca.dot(problem.decision_gradient, plan)
    cost += problem.config.change_weight * problem.previous @ problem.previous

    limits, origins = problem.limits, problem.clamp_origins()
    moves = problem.origin_map()
    box = ca.mtimes(ca.DM(moves.reshape(6 * N, -1)), plan)
    corner_low, corner_high = np.asarray(limits.workspace)
    gaps = [
        origins[1] - origins[0] + ca.mtimes(ca.DM(moves[k, 1] - moves[k, 0]), plan)
        for k in range(N)
    ]
    distances = ca.vertcat(*[ca.norm_2(gap) for gap in gaps])
    present = problem.boundary.distance
    longest = max(limits.max_gripper_distance, present)
    shortest = min(limits.min_gripper_distance, present)
    solver = ca.nlpsol(
        "reference",
        "ipopt",
        {"x": plan, "f": cost, "g": ca.vertcat(box, distances)},
        {
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.max_iter": max_iterations,
            "ipopt.tol": 1e-8,
            # On a kink of the ReLU network no gradient vanishes: there, stop when the cost stands.
            "ipopt.acceptable_tol": 1e10,
            "ipopt.acceptable_dual_inf_tol": 1e10,
            "ipopt.acceptable_compl_inf_tol": 1e-4,
            "ipopt.acceptable_constr_viol_tol": 1e-8,
            "ipopt.acceptable_obj_change_tol": 1e-4,
            "ipopt.acceptable_iter": 5,
            "ipopt.mu_init": 1e-5,
            "print_time": False,
        },
    )
    solution = solver(
        x0=start.ravel(),
        lbx=-1.0,
        ubx=1.0,
        lbg=np.concatenate(
            [np.tile((np.minimum(corner_low, origins) - origins).ravel(), N), np.full(N, shortest)]
        ),
        ubg=np.concatenate(
            [np.tile((np.maximum(corner_high, origins) - origins).ravel(), N), np.full(N, longest)]
        ),
    )
    stats = solver.stats()
    if not stats["success"]:
        raise SolverFailed(f"ipopt: {stats['return_status']}")
    optimum = np.asarray(solution["x"]).reshape(N, m)
    rollout = ca.Function("rollout", [plan], [ca.horzcat(*shapes)])
    predicted = np.asarray(rollout(optimum.ravel())).T.reshape(N, -1, 3)
    return Plan(optimum, predicted, float(solution["f"]))
