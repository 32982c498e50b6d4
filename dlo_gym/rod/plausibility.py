"""What is wrong with the end of a move, in words."""

from dlo_gym.rod._kernels_move import BENT, CONVERGED, STRAINED, Bounds


def problem_of(status: int, measure: float, bounds: Bounds) -> str:
    """Of a kernel's status and what it measures; "" if nothing is wrong."""
    if status == CONVERGED:
        return ""
    if status == STRAINED:
        return f"an element is strained by {measure:.2g}, beyond {bounds.strain:.2g}"
    if status == BENT:
        return (
            f"neighbouring elements bend by {measure:.2g} rad, beyond {bounds.bend:.2g}: more"
            " elements may help"
        )
    return f"no convergence in {measure:.0f} Newton steps"
