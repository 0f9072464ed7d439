# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""docs/ builds without a warning, every link leads to a page and a heading, and no page needs a network."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from docs_examples import ROOT, environment

import calib_planner

pytest.importorskip("sphinx", reason="pip install 'calib_planner[docs]'")
pytest.importorskip("myst_parser", reason="pip install 'calib_planner[docs]'")
pytest.importorskip("furo", reason="pip install 'calib_planner[docs]'")


class Page(HTMLParser):
    """What a page loads, where it leads, and the names within it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.leads: list[str] = []
        self.names: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        at = dict(attrs)
        self.names |= {v for k, v in attrs if k in ("id", "name") and v}
        if tag == "a" and at.get("href"):
            self.leads.append(at["href"] or "")
        elif tag in ("img", "script", "iframe", "source") and at.get("src"):
            self.loads.append(at["src"] or "")
        elif tag == "link" and at.get("rel") not in ("canonical", "author"):
            self.loads.append(at.get("href") or "")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    command += ["-d", str(folder / "trees"), str(ROOT / "docs"), str(folder / "html")]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def pages(built: Path) -> dict[Path, Page]:
    return {p: Page(p.read_text(encoding="utf-8")) for p in built.rglob("*.html") if "_static" not in p.parts}


def test_every_page_is_there(pages: dict[Path, Page], built: Path) -> None:
    sources = [p.relative_to(ROOT / "docs").with_suffix(".html") for p in (ROOT / "docs").rglob("*.md")]
    sources = [p for p in sources if p.parts[0] not in ("examples", "_build")]
    assert len(sources) >= 15
    assert not [p for p in sources if built / p not in pages]


def test_python_page_has_every_public_name(pages: dict[Path, Page], built: Path) -> None:
    shown = pages[built / "reference" / "python.html"].names
    assert not [name for name in calib_planner.__all__ if f"calib_planner.{name}" not in shown]
    assert "calib_planner.Robot.jacobian" in shown


def test_every_link_leads_to_a_page_and_a_heading(pages: dict[Path, Page]) -> None:
    lost = []
    for path, page in pages.items():
        for link in page.leads:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            known = target in pages and (not parts.fragment or unquote(parts.fragment) in pages[target].names)
            if not known and not (target.exists() and target.suffix != ".html"):
                lost.append(f"{path.name}: {link}")
    assert not lost


def test_no_page_loads_anything_from_a_network(pages: dict[Path, Page], built: Path) -> None:
    assert not [src for page in pages.values() for src in page.loads if urlsplit(src).netloc]
    sheets = list(built.rglob("*.css"))
    assert sheets
    assert not [
        s.name for s in sheets if re.search(r"url\(\s*['\"]?(?:https?:)?//", s.read_text(errors="replace"))
    ]
