"""READMEs and pages of docs/: what stands in them without being typed is checked here."""

import re

from tests.deb.picture import lines_of_readme, text_of
from tests.deb.typed_pages import ELSEWHERE, FROM_NOTHING, WITH_ROBOT
from tests.system.typed import command_of, typed_lines
from tests.unit.checkout import CHECKOUT

PICTURE = CHECKOUT / "docs/first-minute.svg"
PAGES = [*CHECKOUT.glob("README*.md"), *sorted((CHECKOUT / "docs").glob("*.md"))]


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            assert "://" in target or (page.parent / target).exists(), (page.name, target)


def test_a_test_types_each_page_that_has_commands() -> None:
    pages = {
        str(page.relative_to(CHECKOUT))
        for page in PAGES
        if re.search(r"^\$ ", page.read_text(), re.MULTILINE)
    }
    assert pages == {*FROM_NOTHING, *WITH_ROBOT, *ELSEWHERE}
    for page, test in ELSEWHERE.items():
        assert page.rpartition("/")[2] in (CHECKOUT / test).read_text()


def test_readme_is_short() -> None:
    lines = (CHECKOUT / "README.md").read_text().splitlines()
    assert len(lines) <= 200
    assert "make demo" in "\n".join(lines[:100]) and "make test" in "\n".join(lines[:100])


def test_both_readmes_have_the_same_blocks_and_links() -> None:
    """What is typed in one is typed in the other; tests/deb types those of README.md."""
    texts = [(CHECKOUT / name).read_text() for name in ("README.md", "README.zh-CN.md")]
    blocks, links = (
        [re.findall(pattern, text, re.DOTALL | re.MULTILINE) for text in texts]
        for pattern in (r"^```.*?^```$", r"\]\((docs/[^)]*)\)")
    )
    assert blocks[0] == blocks[1]
    assert set(links[0]) == set(links[1])
    assert "](README.zh-CN.md)" in texts[0] and "](README.md)" in texts[1]


def test_the_picture_shows_what_readme_says() -> None:
    """So it is as true as README.md, which tests/deb types: tests/deb/picture.py draws it."""
    shown = {one.line: one.shown for one in typed_lines(text_of(PICTURE.read_text()))}
    said = {command_of(one.line).rstrip(): one for one in lines_of_readme()}
    assert len(shown) == 5
    for line, text in shown.items():
        assert text and said[line].fits(text, 0), line
