"""What the pages say to run, runs."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parent.parent / "docs"


def blocks(page):
    return "\n".join(re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL))


def test_tutorial_runs_as_it_stands(data_folder, tmp_path, monkeypatch, capsys):
    (tmp_path / "wrists").symlink_to(data_folder)
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("tutorial.md"), "docs/tutorial.md", "exec"), {"__name__": "tutorial"})
    assert "00001_labels.nii.gz (360, 800, 80)" in capsys.readouterr().out


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_page_links_to_what_is_there(page):
    for target in re.findall(r"\]\((?!http)([^)#]+)", (DOCS / page).read_text()):
        assert (DOCS / target).exists(), target
