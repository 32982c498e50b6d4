"""The Python examples of the README and the docs run as they stand."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parent.parent / "README.md"


@pytest.mark.parametrize(
    "page", ["README.md", "docs/rod.md", "docs/control.md", "docs/surrogate.md"]
)
def test_python_examples_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (README.parent / page).read_text()
    examples = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    assert examples
    names = {}  # a page reads from top to bottom
    for example in examples:
        exec(compile(example, page, "exec"), names)


def test_pictures_and_documents_it_names_exist():
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", README.read_text())
    assert links
    for link in links:
        assert (README.parent / link).exists(), link


def test_commands_it_names_exist():
    from dlo_gym.cli import COMMANDS

    named = set(re.findall(r"\bdlo ([a-z][a-z-]+)", README.read_text()))
    assert named
    assert named <= {name.split()[0] for name in COMMANDS}
