"""Writes measured tables and pictures between the markers of docs/validation.md."""

import re
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.validation.case import Case
from dlo_gym.atomic_file import written_aside
from dlo_gym.exceptions import DloError

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "validation.md"
PICTURES = DOCS / "images" / "validation"


def write(name: str, case: Case) -> None:
    """Replace what stands between ``<!-- name -->`` and the next ``<!-- end -->``.

    Raises:
        ValueError: if the page has no such place.
    """
    parts = [table(case)]
    if case.draw is not None:
        figure = Figure(figsize=case.size, layout="constrained")
        case.draw(figure)
        PICTURES.mkdir(parents=True, exist_ok=True)
        with written_aside(PICTURES / f"{name}.png", DloError) as part:
            figure.savefig(part, format="png", dpi=100, metadata={"Software": None})
        parts.append(f"![{name}](images/validation/{name}.png)")
    text = PAGE.read_text(encoding="utf-8")
    filled, count = re.subn(
        rf"(<!-- {re.escape(name)} -->\n).*?(<!-- end -->)",
        lambda match: match[1] + "\n" + "\n\n".join(parts) + "\n\n" + match[2],
        text,
        flags=re.DOTALL,
    )
    if count != 1:
        raise ValueError(f"name: expected one place <!-- {name} --> in {PAGE.name}, found {count}")
    with written_aside(PAGE, DloError) as part:
        part.write_text(filled, encoding="utf-8")


def table(case: Case) -> str:
    """The case's rows in Markdown, figures to the right."""
    lines = [case.header, ["---", *["---:"] * (len(case.header) - 1)], *case.rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
