"""What the tests of the status page look at."""

from pathlib import Path
from typing import Any

from tests.system.chromium import Browser

AXE = Path("/opt/axe/axe_playwright_python/axe.min.js")
SCHEMES = ("light", "dark")
"""What readers can choose."""
_JUDGED = """
axe.run(document, {resultTypes: ['violations']}).then((found) => found.violations.map(
  (one) => [one.id, one.help, ...one.nodes.map((node) => node.html.slice(0, 300))]))
"""

CONTRAST = """
(() => {
  const parse = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b]
    .map((c) => c / 255).map((c) => c <= .03928 ? c / 12.92 : ((c + .055) / 1.055) ** 2.4)
    .reduce((sum, c, at) => sum + c * [.2126, .7152, .0722][at], 0);
  const ground = (e) => {
    for (; e; e = e.parentElement) {
      const color = parse(getComputedStyle(e).backgroundColor);
      if (color.length === 3 || color[3] > 0) return color;
    }
    return [255, 255, 255];
  };
  const bad = [];
  for (const e of document.querySelectorAll('body *')) {
    const own = [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim());
    if (!own || !e.checkVisibility() || e.closest('svg, :disabled, option')) continue;
    const [a, b] = [light(parse(getComputedStyle(e).color)), light(ground(e))];
    const ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
    if (ratio < 4.5) bad.push([e.className, e.textContent.slice(0, 30), ratio.toFixed(2)]);
  }
  return bad;
})()
"""
"""Texts of too little contrast with what is behind them, see WCAG 2.1, 1.4.3."""

CUT = """
[...document.querySelectorAll('.lines .who, .card strong, .nodes .name, h1')]
  .filter((e) => e.checkVisibility() && e.scrollWidth > e.clientWidth + 1)
  .map((e) => e.textContent)
"""
"""Names that are not to be read in full."""


def faults(browser: Browser) -> list[Any]:
    """What axe-core finds on the page as it is now."""
    if not browser.js("'axe' in window"):
        browser.js(f"{AXE.read_text()};0")
    found = browser.js(_JUDGED)
    assert isinstance(found, list)
    return found


def look(browser: Browser, name: str) -> None:
    """A picture of what everybody can read, in each scheme."""
    for scheme in SCHEMES:
        browser.prefer(scheme)
        assert browser.js(CONTRAST) == [], scheme
        assert faults(browser) == [], scheme
        browser.picture(f"{name}-{scheme}", is_whole=True)


def node(name: str) -> str:
    """The line of a node."""
    return f"#detail .nodes li[data-node={name}]"


def box(name: str) -> str:
    """A node in the drawing."""
    return f".graph [data-node={name}]"
