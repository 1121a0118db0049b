"""The pages say what the code does, and every link between them leads somewhere."""

import doctest
import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def script(name):
    """A script of docs/, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_formats_is_what_its_command_writes():
    assert script("write").formats() == (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")


OLD = """text

<!-- table -->

| scene | way | PSNR |
|---|---|---|
| a | fast | 30 dB |
| a | slow | 40 dB |

<!-- end -->

<!-- log -->
<!-- end -->
"""


def test_what_a_command_prints_takes_its_place_in_a_page_and_rows_that_were_not_measured_stay():
    insert = script("insert")
    new = "| scene | way | PSNR |\n|---|---|---|\n| a | slow | 41 dB |\n| b | slow | 20 dB |\n"
    page = insert.inserted(OLD, "table", new, by=2)
    assert page == OLD.replace("| 40 dB |", "| 41 dB |\n| b | slow | 20 dB |")
    assert "fast" not in insert.inserted(OLD, "table", new)
    assert insert.inserted(page, "table", new, by=2) == page
    assert "<!-- log -->\n\n    .glb: 3 MB\n\n<!-- end -->" in insert.inserted(OLD, "log", ".glb: 3 MB\n")
    with pytest.raises(ValueError, match="no section"):
        insert.inserted(OLD, "nothing", new)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_section_that_a_command_writes_has_an_end(page):
    marks = re.findall(r"<!-- (.+?) -->", page.read_text(encoding="utf-8"))
    assert marks[1::2] == ["end"] * (len(marks) // 2) and "end" not in marks[::2]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page):
    links = re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_every_page_can_be_reached_from_the_readme(page):
    assert f"docs/{page.name}" in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.long
def test_the_session_of_the_python_page_runs_as_it_stands(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8").replace("OUT/", f"{tmp_path}/")
    session = doctest.DocTestParser().get_doctest(text.replace("```", ""), {}, "python.md", None, 0)
    assert len(session.examples) > 10
    told = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(session, out=told.append)
    assert "".join(told) == ""
