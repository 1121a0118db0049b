"""Puts what a benchmark prints into a page: BENCHMARK | python docs/insert.py PAGE SECTION [--by N].

A page marks a section by <!-- SECTION --> before it and <!-- end --> after it. What has a table goes in as it
is, anything else as text that is not set. With --by N rows of the section's table stay whose first N cells no
new row has, so that a command may measure a part of them.
"""

import argparse
import re
import sys
from pathlib import Path


def inserted(page: str, section: str, printed: str, by: int = 0) -> str:
    """``page`` with what was ``printed`` in its ``section``. Raises ValueError where it has none."""
    found = re.search(rf"(<!-- {re.escape(section)} -->\n)(.*?)(<!-- end -->)", page, re.DOTALL)
    if found is None:
        raise ValueError(f"the page has no section <!-- {section} --> … <!-- end -->")
    lines = printed.strip("\n").splitlines()
    if not any(line.startswith("|") for line in lines):
        shown = "\n" + "".join(f"    {line}".rstrip() + "\n" for line in lines) + "\n"
    else:
        shown = (
            "\n" + "".join(f"{line}\n" for line in merged(found[2].strip().splitlines(), lines, by)) + "\n"
        )
    return page[: found.end(1)] + shown + page[found.start(3) :]


def merged(old: list[str], new: list[str], by: int) -> list[str]:
    """The lines of the table ``old`` with those of ``new`` for rows that begin with the same ``by`` cells;
    further ones at the end. ``new`` alone where ``by`` is 0, or where the columns are not the same. Its head
    may come again, as from several commands."""
    if not by or old[:1] != new[:1]:
        return new
    rows = {key(line, by): line for line in old[2:]}
    rows |= {key(line, by): line for line in new if line not in new[:2]}
    return [*new[:2], *rows.values()]


def key(line: str, by: int) -> tuple[str, ...]:
    """The first ``by`` cells of a row."""
    return tuple(cell.strip() for cell in line.strip("|").split("|")[:by])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("page", type=Path)
    parser.add_argument("section")
    parser.add_argument("--by", type=int, default=0)
    asked = parser.parse_args()
    text = inserted(asked.page.read_text(encoding="utf-8"), asked.section, sys.stdin.read(), asked.by)
    asked.page.write_text(text, encoding="utf-8")
    print(f"wrote {asked.section} to {asked.page}")
