"""Small dataflows made of a seed: the same seed gives the same files. Pure.

Every node ends by itself. What it is started with and its own lines begin with one of MARKS, since
dora and zenoh write to the same streams.
"""

import json
import random
from collections.abc import Callable
from dataclasses import dataclass

MARKS = ("seen:", "out:", "err:")

_SAY = """#!/usr/bin/env python3
import json, os, signal, sys
names = json.loads(os.environ["NAMES"])
own = sorted(name for name in os.environ if name.startswith("DORA_SYSTEMD"))
seen = [sys.argv, os.getcwd(), {name: os.environ.get(name) for name in names}, own]
print("seen:", json.dumps(seen), flush=True)
for number, line in LINES:
    os.write(number, line)
"""
_NODE = """
from dora import Node
node, left = Node(), TICKS
for event in node:
    if event["type"] != "INPUT" or event["id"] != "tick":
        continue
    left -= 1
    node.send_output("words", b"x")
    if left == 0:
        break
if EXIT < 0 and node.restart_count() < FAILURES:
    os.kill(os.getpid(), -EXIT)
sys.exit(EXIT if node.restart_count() < FAILURES else 0)
"""
_OPERATOR = """
from dora import DoraStatus
class Operator:
    left = TICKS
    def on_event(self, event, send_output):
        if event["type"] == "INPUT":
            self.left -= 1
            send_output("words", b"x", {})
        return DoraStatus.CONTINUE if self.left > 0 else DoraStatus.STOP
"""
_SHELL = (
    r"""printf 'out: %s\n' "$0" "$(pwd)" "$ALL" 'TEXT'; """
    r"""exec python3 -c 'from dora import Node; Node()'"""
)
"""A node that ends without a word to dora makes those fail that have not spoken to it yet."""

_IDENTS = ("5", "1.10", "true", "null.x", "node", "a-b", "A_b", "x.y.z", "0x10", "output", "-a")
_NAMES = ("A", "B", "my.var", "MY-VAR", "node", "directory", "output", "last", "IFS")
_PLAIN: tuple[str, ...] = (
    *("1", "007", "1.50", "1e3", "0x1F", ".5", "-0.0", "true", "no", "~x", "'~'", "''", "a  b"),
    *("'${CALLER}'", "x$CALLER.y", "'${NONE:-d e}'"),
)
_VALUES: tuple[str, ...] = (*_PLAIN, "inf", "'-inf'", "NaN", "$$", "a$$b")
"""Of `env:`, as in YAML. The caller has CALLER, and no NONE."""
_ODD = "ab0 \t\n'\"\\$`#*=-;|&ü☕{}[]~%!:,<>?^"
_PLAIN_ARGS = ("1.50", "007", "0x10", "true", "~", "--a b", "a#b")
_LINES = (
    *(b"plain", b"", b"  space  ", b"tab\there", b"return\r", b"a\rb", b"\x1b[31mred\x1b[0m"),
    *("ünï ☕".encode(), b"bad \xff\xfe", b"x" * 20_000, b'{"level": "info"}'),
)
_EXITS = (1, 3, 42, 255, -9, -15)
"""Statuses; below 0, signals."""
_DIRECTORIES = {"": "", "./": "", "../project/": "", "sub/": "sub/", "ö d'#/": "ö d'#/"}
"""As a path begins, and where the file is."""


@dataclass(frozen=True)
class Flow:
    """A dataflow in the directory `project`. files: by name; all of them may be executed."""

    text: str
    files: dict[str, str]
    idents: tuple[str, ...]


@dataclass
class _Maker:
    """is_plain: no variable that dora's runtime of operators cannot read, in any node."""

    dice: random.Random
    is_plain: bool
    files: dict[str, str]

    def program(self, name: str, body: str, ticks: int) -> None:
        """A file that says its lines and goes on with `body`."""
        lines = self.dice.choices(_LINES, k=self.dice.randint(0, 6))
        marked = [self.dice.choice(((1, b"out: "), (2, b"err: "))) for _ in lines]
        said = [(fd, mark + line + b"\n") for (fd, mark), line in zip(marked, lines, strict=True)]
        exit_status, failures = self.dice.choice(_EXITS), self.dice.choice((0, 0, 0, 0, 0, 0, 1, 2))
        constants = {"TICKS": ticks, "LINES": said, "EXIT": exit_status, "FAILURES": failures}
        given = "".join(f"{key} = {value!r}\n" for key, value in constants.items())
        first, _, rest = _SAY.partition("\n")
        self.files[name] = f"{first}\n{given}{rest}{body}"

    def env(self) -> str:
        """Variables in a line of YAML, with the names of all of them."""
        names = self.dice.sample(_NAMES, self.dice.randint(0, 4))
        pairs = {name: self.value() for name in names}
        pairs["NAMES"] = f"'{json.dumps(['ALL', *names])}'"
        return f"{{{', '.join(f'{name}: {value}' for name, value in pairs.items())}}}"

    def value(self) -> str:
        """A variable's, as in YAML."""
        known = _PLAIN if self.is_plain else _VALUES
        return self.dice.choice([*known, _quoted(self.text())])

    def text(self) -> str:
        """Any text. A variable that is not set would be refused."""
        text = "".join(self.dice.choices(_ODD, k=self.dice.randint(0, 8)))
        return text.replace("$", "" if self.is_plain else "$$")

    def args(self) -> str:
        """A value of `args:`: a plain scalar, or words with quotes of the shell."""
        if self.dice.random() < 0.25:
            return self.dice.choice(_PLAIN_ARGS)
        quotes: tuple[Callable[[str], str], ...] = (_single, _double, _escaped, _bare)
        words = [
            self.dice.choice(quotes)("".join(self.dice.choices(_ODD, k=self.dice.randint(0, 7))))
            for _ in range(self.dice.randint(1, 5))
        ]
        text = self.dice.choice((" ", "  ", "\t", "\n", " \\\n ")).join(words)
        return _quoted(text)

    def restarts(self) -> str:
        chosen = self.dice.choice(("", "", "restart_policy: never", "restart_policy: on-failure"))
        is_limited = "on-failure" in chosen
        return chosen + (f", max_restarts: {self.dice.randint(1, 2)}" if is_limited else "")


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _single(word: str) -> str:
    return "'" + word.replace("'", "") + "'"


def _double(word: str) -> str:
    return '"' + "".join(f"\\{char}" if char in '"\\$`' else char for char in word) + '"'


def _escaped(word: str) -> str:
    return "".join(f"\\{char}" for char in word)


def _bare(word: str) -> str:
    """Without quotes, so that "#" and "$" mean what they mean."""
    return "".join(char for char in word if char not in "'\"\\")


def make_flow(seed: int) -> Flow:
    """The dataflow of that seed."""
    dice = random.Random(seed)
    maker = _Maker(dice, dice.random() < 0.4, {})
    idents = dice.sample(_IDENTS, dice.randint(2, 4))
    other = _operator if maker.is_plain else _tool
    kinds = [_python_node, other, *dice.choices((_python_node, _shell, other), k=2)]
    nodes = [kind(maker, ident) for kind, ident in zip(kinds, idents, strict=False)]
    if dice.random() < 0.6:
        nodes.append(_listener(maker, idents[0]))
        idents.append("listener")
    shared = f"env: {{ALL: {maker.value()}, A: of all}}\n"
    document = f"{shared}nodes:\n" + "".join(f"  - {node}\n" for node in nodes)
    return Flow(document, maker.files, tuple(idents))


def _python_node(maker: _Maker, ident: str) -> str:
    name = f"n{len(maker.files)}.py"
    path, place = maker.dice.choice(list(_DIRECTORIES.items()))
    maker.program(place + name, _NODE, maker.dice.randint(1, 4))
    return _custom(maker, ident, path + name)


def _tool(maker: _Maker, ident: str) -> str:
    name = f"tool{len(maker.files)}"
    maker.program(name, _NODE, maker.dice.randint(1, 4))
    return _custom(maker, ident, name)


def _custom(maker: _Maker, ident: str, path: str) -> str:
    keys = [
        f"id: {ident}",
        f"path: {_quoted(path)}",
        f"args: {maker.args()}",
        f"env: {maker.env()}",
    ]
    keys += ["inputs: {tick: dora/timer/millis/50}", "outputs: [words, said]", maker.restarts()]
    keys += maker.dice.choice(([], [], [], ["send_stdout_as: said"]))
    return f"{{{', '.join(filter(None, keys))}}}"


def _shell(maker: _Maker, ident: str) -> str:
    args = _quoted(_SHELL.replace("TEXT", _bare(maker.text())))
    return f"{{id: {ident}, path: shell, args: {args}, env: {maker.env()}}}"


def _operator(maker: _Maker, ident: str) -> str:
    name = f"operator{len(maker.files)}.py"
    maker.program(name, _OPERATOR, maker.dice.randint(1, 4))
    part = f"python: {name}, inputs: {{tick: dora/timer/millis/50}}, outputs: [words]"
    if maker.dice.random() < 0.5:
        return f"{{id: {ident}, operator: {{{part}}}, env: {maker.env()}}}"
    return f"{{id: {ident}, operators: [{{id: part, {part}}}], env: {maker.env()}}}"


def _listener(maker: _Maker, source: str) -> str:
    """It ends because its only input is closed."""
    maker.program("listener.py", _NODE, 1)
    return (
        f"{{id: listener, path: listener.py, outputs: [words], env: {maker.env()}, "
        f"inputs: {{words: {source}/words}}}}"
    )
