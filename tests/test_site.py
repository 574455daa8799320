"""The documentation site is whole: every link leads somewhere, and nothing comes from elsewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs_script import script

ROOT = Path(__file__).parents[1]
WHOLE = '<p id="a"><a href="index.html#a">up</a> <code>$x$</code></p>'


check_site, site_pages = script("check_site"), script("site_pages")


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A site of one page and one style sheet, in which all is well."""
    (tmp_path / "index.html").write_text(WHOLE)
    (tmp_path / "a.css").write_text("p { color: red }")
    return tmp_path


def test_a_whole_site_has_no_problems(site: Path) -> None:
    assert list(check_site.problems(site)) == []


@pytest.mark.parametrize(
    ("added", "problem"),
    [
        ('<a href="gone.html">x</a>', "links to gone.html, which does not exist"),
        ('<a href="#gone">x</a>', "links to #gone, which has no such anchor"),
        ('<img src="gone.png">', "requests gone.png, which does not exist"),
        ('<script src="https://a.b/c.js"></script>', "requests https://a.b/c.js, which is not"),
        ('<link rel="stylesheet" href="//a.b/c.css">', "requests //a.b/c.css, which is not"),
        ('<p style="background: url(https://a.b/c)">', "requests https://a.b/c, which is not"),
        ("<p>the mass $m$</p>", "shows the mass $m$"),
        ("<p>of \\(m\\)</p>", "shows of \\(m\\)"),
        ("<p>two kinds:\n- one\n- two</p>", "shows two kinds: - one - two"),
    ],
)
def test_a_broken_page_is_found(site: Path, added: str, problem: str) -> None:
    (site / "index.html").write_text(WHOLE + added)
    (found,) = check_site.problems(site)
    assert found.startswith(f"index.html {problem}")


def test_a_broken_style_and_a_page_without_links_are_found(site: Path) -> None:
    (site / "a.css").write_text("@font-face { src: url('https://a.b/c.woff2') }")
    (site / "other.html").write_text("")
    lonely, style = check_site.problems(site)
    assert lonely == "nothing links to other.html"
    assert style.startswith("a.css requests https://a.b/c.woff2, which is not")


def test_the_navigation_has_every_page() -> None:
    listed = re.findall(r"(\S+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.MULTILINE)
    pages = {str(path.relative_to(ROOT)) for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"))}
    pages |= {f"examples/{path.stem}.md" for path in ROOT.glob("examples/*.py")}
    pages |= {f"reference/{package}.md" for package in site_pages.PACKAGES}
    assert sorted(listed) == sorted(pages | {"examples/index.md", "reference/index.md"})


@pytest.fixture(scope="module")
def built() -> Path:
    """The site, as `make docs` builds it."""
    for command in (["docs/site_pages.py"], ["-m", "zensical", "build"]):
        subprocess.run([sys.executable, *command], cwd=ROOT, check=True)
    return check_site.SITE


@pytest.mark.slow
def test_the_site_is_whole(built: Path) -> None:
    assert list(check_site.problems(built)) == []
    for package in site_pages.PACKAGES:
        page = check_site.Page(built / "reference" / f"{package}.html")
        missing = set(site_pages.exported(package)[1].values()) - page.anchors
        assert not missing, f"{package}: the reference lacks {missing}"


@pytest.mark.slow
@pytest.mark.skipif(check_site.installed_browser() is None, reason="no Chromium is installed")
def test_a_browser_shows_the_formulas_and_requests_nothing_elsewhere(built: Path) -> None:
    assert list(check_site.problems_in_browser(built, check_site.installed_browser())) == []


@pytest.mark.slow
@pytest.mark.skipif(check_site.installed_browser() is None, reason="no Chromium is installed")
def test_what_only_a_browser_finds(tmp_path: Path) -> None:
    script = '<script>fetch("https://a.invalid/b")</script>'
    (tmp_path / "index.html").write_text(f'<span class="arithmatex">\\(x\\)</span>{script}')
    requested, formulas = check_site.problems_in_browser(tmp_path, check_site.installed_browser())
    assert requested == "index.html requests https://a.invalid/b in a browser"
    assert formulas == "index.html shows 0 of 1 formulas in a browser"
