"""The picture of a sweep over rods, after Fig. 6 of the paper."""

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

COLOURS = ("#c44e52", "#2f6db2", "#55a868", "#8172b2")


def plot_scores(cells: list[dict[str, Any]], names: list[str], file: Path) -> None:
    """Writes a PNG: a panel per radius, per Young's modulus and number of steps a box from the
    first to the third quartile and a line from the 5th to the 95th percentile of PTP3D."""
    radii = sorted({cell["radius"] for cell in cells})
    moduli = sorted({cell["youngs_modulus"] for cell in cells})
    steps = sorted({cell["n_steps"] for cell in cells})
    figure = Figure(figsize=(10.0, 2.3 * len(radii)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(radii), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    width = 0.8 / (len(steps) * len(names))
    for panel, radius in zip(panels, radii, strict=True):
        for cell in (cell for cell in cells if cell["radius"] == radius):
            network, step = names.index(cell["network"]), steps.index(cell["n_steps"])
            offset = (step * len(names) + network + 0.5) * width - 0.4
            place = moduli.index(cell["youngs_modulus"]) + offset
            low, first, median, third, high = cell["percentiles_mm"]
            colour = COLOURS[network % len(COLOURS)]
            panel.vlines(place, low, high, color=colour, linewidth=1.0)
            panel.bar(
                place, third - first, 0.75 * width, bottom=first, color=colour, edgecolor="none"
            )
            panel.hlines(median, place - 0.37 * width, place + 0.37 * width, color="white")
        panel.set(yscale="log", ylabel="PTP3D [mm]")
        panel.set_title(f"radius {1e3 * radius:g} mm", loc="left", fontsize=10)
        panel.grid(axis="y", alpha=0.3)
        for edge in range(1, len(moduli)):
            panel.axvline(edge - 0.5, color="0.8", linewidth=0.8)
    panels[-1].set_xticks(range(len(moduli)), [f"{modulus:.0e} Pa" for modulus in moduli])
    panels[-1].set_xlabel(
        f"Young's modulus; in each, from left to right, moves of {', '.join(map(str, steps))} steps"
    )
    handles = [Line2D([], [], color=COLOURS[i % len(COLOURS)], lw=6) for i in range(len(names))]
    panels[0].legend(handles, names, loc="upper left", fontsize=8, ncols=len(names))
    figure.savefig(file, format="png", dpi=80)
