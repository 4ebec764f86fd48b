"""Draw docs/first-minute.svg: a terminal in which the first commands of README.md were typed.

    LAB_OUT=DIR tests/lab/lab run -- python -m tests.deb.picture /out/first-minute.svg

What the commands showed is in the picture, with its colours. A unit test compares the picture with
what README.md says of each command.
"""

import html
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.deb import packages
from tests.system.cells import run
from tests.system.typed import Shell, Typed, command_of, type_line, typed_lines

TYPED = re.compile(r"doractl (start|list|why)\b|sed ")
"""The commands that are in the picture; the others are typed and not shown."""
COLOURS = {"31": "#ff7b72", "32": "#7ee787", "33": "#e3b341", "36": "#79c0ff", "2": "#8b949e"}
WIDTH, LINE, LEFT = 880, 18, 16
HEAD = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">
<title>doractl start, list and why in a terminal: a node fails, and why says why</title>
<rect width="{width}" height="{height}" rx="8" fill="#0d1117"/>
<g font-family="ui-monospace, Menlo, Consolas, monospace" font-size="14" fill="#e6edf3">
"""


def as_svg(lines: list[str]) -> str:
    """The lines of a terminal, with escape sequences for colours, as a picture."""
    texts = [
        f'<text x="{LEFT}" y="{LINE * row + LEFT}" xml:space="preserve">{coloured(line)}</text>\n'
        for row, line in enumerate(lines, 1)
    ]
    height = LINE * (len(lines) + 1) + LEFT
    return "".join([HEAD.format(width=WIDTH, height=height), *texts, "</g>\n</svg>\n"])


def coloured(line: str) -> str:
    """One line, each run of characters of one look as an element."""
    found, style = [], ""
    for part in re.split(r"(\x1b\[[0-9;]*m)", line):
        if codes := re.fullmatch(r"\x1b\[([0-9;]*)m", part):
            style = look(codes[1].split(";"), style)
        elif part:
            text = html.escape(re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]|\x1b[=>]|\r", "", part))
            found.append(f"<tspan{style}>{text}</tspan>" if style else text)
    return "".join(found)


def look(codes: list[str], style: str) -> str:
    """The attributes for codes of SGR, added to those before; without a code or with 0, none."""
    for code in codes:
        if code in ("", "0"):
            style = ""
        elif code == "1":
            style += ' font-weight="bold"'
        elif code in COLOURS:
            style += f' fill="{COLOURS[code]}"'
    return style


def text_of(picture: str) -> str:
    """What is written in a picture, as a page would have it."""
    lines = re.findall(r"<text [^>]*>(.*)</text>", picture)
    return "".join(html.unescape(re.sub(r"<[^>]*>", "", line)) + "\n" for line in lines)


def lines_of_readme() -> Iterator[Typed]:
    """The lines that README.md types in its first minute."""
    text = (packages.CHECKOUT / "README.md").read_text(encoding="utf-8")
    block = re.search(r"^```\n(\$ .*?)^```", text, re.DOTALL | re.MULTILINE)
    assert block
    yield from typed_lines(block[1])


def main(target: Path) -> None:
    """Type them in the robot's directory, and draw."""
    place = Path("/srv/robot")
    shutil.copytree(packages.ROBOT, place)
    packages.make_venv(place / ".venv")
    shell = Shell(("env",), place)
    lines: list[str] = []
    for typed in lines_of_readme():
        if not TYPED.match(typed.line):
            continue
        shown, status = type_line(shell, typed)
        assert typed.fits(shown, status), shown
        told = re.sub(r"[^\n]*\r\x1b\[K", "", shown).splitlines()
        if "start" in typed.line.split():
            told = [*told[:3], "..."]  # the rest is about this lab's users
        lines += [f"\x1b[1m$ {command_of(typed.line).rstrip()}\x1b[0m", *told]
    shell.end()
    run("doractl", "destroy", "--force")
    target.write_text(as_svg(lines), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
