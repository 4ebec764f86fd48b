"""What `doractl top` shows on a terminal, and what its keys do. Pure: no clock, no terminal."""

from collections.abc import Sequence
from typing import NamedTuple

from dora_systemd.decisions.views.dataflows import STATE_COLORS, format_table
from dora_systemd.decisions.views.formats import local_time
from dora_systemd.decisions.views.top import (
    HEADER,
    NOTHING,
    SORTS,
    Look,
    TopRow,
    format_summary,
    top_rows,
)
from dora_systemd.terminal_text import cut

HELP = """
Up Down PgUp PgDn Home End   select a row
c m n                        sort by CPU, memory, name
r                            reverse the order
R                            restart the selected row
S                            stop the selected row
q                            quit

A row is a dataflow, or one of its nodes. R and S ask first.
"""

_HINT = "q quit  ? help  R restart  S stop  c m n sort  r reverse"
_BACK = "Any key goes back."
_CONFIRM = "? y/n"
_SORT_KEYS = {sort[0]: sort for sort in SORTS}
_ACTIONS = {"R": "restart", "S": "stop"}
_FRAME = 3
"""Lines around the rows: title, header, and the last line with a message or a question."""


class Line(NamedTuple):
    """One line of a screen."""

    text: str
    style: str = ""  # words out of bold, reverse, red, yellow


class Change(NamedTuple):
    """A change to make to a row."""

    action: str  # "stop" or "restart"
    row: TopRow

    def __str__(self) -> str:
        row, verb = self.row, self.action.capitalize()
        return f"{verb} node {row.node} of {row.name}" if row.node else f"{verb} {row.name}"


class TopScreen:
    """The screen of `top`, and its reactions to keys.

    by: one of SORTS. is_over: the person has quit. `said`: the message in the last line, unless
    that line has a question.
    """

    def __init__(self, by: str) -> None:
        self.is_over = False
        self.said = ""
        self._by = by
        self._is_reversed = False
        self._wants_help = False
        self._asked: Change | None = None
        self._look = Look(0)
        self._rows: Sequence[TopRow] = ()
        self._chosen: tuple[str, str] | None = None
        self._at = self._first = 0
        self._room = 1

    def see(self, look: Look) -> None:
        """Show another reading; a row that the person has selected stays so, wherever it is now."""
        self._look = look
        self._rows = top_rows(look, self._by, self._is_reversed)
        keys = [row.key for row in self._rows]
        if self._chosen in keys:
            self._at = keys.index(self._chosen)
        self._at = min(self._at, max(len(keys) - 1, 0))

    def press(self, key: str) -> Change | None:
        """Take a key, with a name as in curses(3), "" is none; the change that it confirms."""
        if not key:
            return None
        asked, self._asked, self.said = self._asked, None, ""
        if asked:
            return asked if key in "yY" else None
        if self._wants_help:
            self._wants_help = False
        elif key in _ACTIONS and self._rows:
            self._asked = Change(_ACTIONS[key], self._rows[self._at])
        else:
            self._arrange(key)
        return None

    def _arrange(self, key: str) -> None:
        self.is_over = key in "qQ"
        self._wants_help = key in "?h"
        self._by = _SORT_KEYS.get(key, self._by)
        self._is_reversed ^= key == "r"
        self.see(self._look)
        at = self._targets().get(key)
        if at is not None and self._rows:
            self._at = max(min(at, len(self._rows) - 1), 0)
            # With the first row selected, keep showing the first row, whichever it is now.
            self._chosen = self._rows[self._at].key if self._at else None

    def _targets(self) -> dict[str, int]:
        """The index of the row that each key selects."""
        return {
            "KEY_UP": self._at - 1,
            "KEY_DOWN": self._at + 1,
            "KEY_PPAGE": self._at - self._room,
            "KEY_NPAGE": self._at + self._room,
            "KEY_HOME": 0,
            "KEY_END": len(self._rows) - 1,
        }

    def lines(self, columns: int, height: int) -> list[Line]:
        """The lines for a terminal of that size: `height` of them, with the selected row."""
        self._room = max(height - _FRAME, 1)
        header, *body = self._body(columns)
        title = Line(f"{local_time(self._look.at_us)[-8:]}  {format_summary(self._look)}")
        gap = [Line("")] * (self._room - len(body))
        lines = [title, header, *body, *gap, self._last_line(columns)]
        # A low terminal does without the title, and then without the header.
        return [Line(cut(text, columns), style) for text, style in lines[-height:]]

    def _body(self, columns: int) -> list[Line]:
        """The header, and as many rows as there is room for."""
        if self._wants_help:
            return [Line("doractl top", "bold"), *map(Line, HELP.splitlines()[: self._room])]
        if not self._rows:
            return [Line(""), Line(NOTHING)]
        table = format_table(HEADER, [row.cells for row in self._rows], columns).split("\n")
        self._first = max(min(self._first, self._at, len(self._rows) - self._room), 0)
        self._first = max(self._first, self._at - self._room + 1)
        shown = range(self._first, min(self._first + self._room, len(self._rows)))
        return [
            Line(table[0], "bold"),
            *(self._row_line(at, table[at + 1], columns) for at in shown),
        ]

    def _row_line(self, at: int, text: str, columns: int) -> Line:
        style = STATE_COLORS.get(self._rows[at].state, "")
        return (
            Line(text.ljust(columns), f"{style} reverse") if at == self._at else Line(text, style)
        )

    def _last_line(self, columns: int) -> Line:
        if self._asked:
            return Line(cut(str(self._asked), columns - len(_CONFIRM)) + _CONFIRM, "bold")
        if self._wants_help:
            return Line(_BACK)
        if self.said:
            return Line(self.said)
        last, count = self._first + self._room, len(self._rows)
        return Line(_HINT if count <= self._room else f"{self._first + 1}-{last}/{count}  {_HINT}")
