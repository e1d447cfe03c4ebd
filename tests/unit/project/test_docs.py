"""What the pages of docs/ name exists: messages, modules, tests, commands and benchmarks."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from vical_daemon.cli import table

ROOT = Path(__file__).parents[3]
PAGES = sorted(p for p in (ROOT / "docs").rglob("*.md") if p.name != "log.md" and "_build" not in p.parts)
SOURCES = [
    path
    for folder in ("vical_daemon", "drivers", "mocks", "benchmarks", "tests", "examples", "docs", ".ci")
    for path in (ROOT / folder).rglob("*.py")
]
ids = [str(p.relative_to(ROOT / "docs")) for p in PAGES]


def spans(page: Path) -> list[str]:
    return re.findall(r"`([^`\n]+)`", page.read_text(encoding="utf-8"))


@cache
def code_texts() -> str:
    """Every string of the program; figures and names that an f-string fills in are NUL."""
    texts = []
    for package in ("vical_daemon", "drivers"):
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.JoinedStr):
                    parts = (p.value if isinstance(p, ast.Constant) else "\0" for p in node.values)
                    texts.append("".join(map(str, parts)))
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.append(node.value)
    return "\n".join(texts)


def quoted_messages() -> list[str]:
    """Code in the first column of tables whose first title is "vical says"."""
    quotes = []
    for page in PAGES:
        for rows in re.findall(r"^\| vical says \|.*\n\|[-|]+\n((?:\|.*\n)+)", page.read_text(), re.M):
            for row in rows.splitlines():
                quotes += re.findall(r"`([^`]+)`", row.split(" | ")[0])
    return quotes


def test_every_message_that_the_docs_quote_is_one_of_the_program():
    quotes = quoted_messages()
    assert len(quotes) >= 40
    missing = [
        (quote, part)
        for quote in quotes
        for part in map(str.strip, re.split(r"\(?\.\.\.\)?", quote))
        if part not in code_texts()
    ]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_python_files_that_a_page_names_exist(page):
    names = {span.split("::")[0] for span in spans(page) if re.fullmatch(r"[\w./]+\.py", span)}
    known = [f"/{path.relative_to(ROOT)}" for path in SOURCES]
    assert not {name for name in names if not any(path.endswith(f"/{name}") for path in known)}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_commands_and_studies_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    code = "\n".join([*spans(page), *re.findall(r"^```(?:sh)?\n(.*?)^```", text, re.M | re.S)])
    commands = set(re.findall(r"^(?:sudo )?(?:\S*/bin/)?vical ([a-z][a-z-]+)", code, re.M))
    assert commands <= set(table.available())
    studies = set(re.findall(r"python -m benchmarks ([a-z_]+)", text))
    assert studies <= {path.stem for path in (ROOT / "benchmarks").glob("*.py")}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_tables_are_whole(page):
    """A blank line within a table makes the rest of it a paragraph; the second line rules off the titles."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    for table_rows in re.findall(r"(?:^\|.*\n)+", text, re.M):
        rows = table_rows.splitlines()
        assert len(rows) > 1
        assert re.fullmatch(r"\|[\s:|-]+\|", rows[1]), rows[0]
