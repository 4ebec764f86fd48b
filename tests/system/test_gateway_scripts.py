"""Scripts of the status page in a real browser, with data that a dataflow rarely has."""

import json

import pytest

from tests.system.chromium import Browser

pytestmark = [pytest.mark.lab, pytest.mark.browser]

TIMES = """
import('/page/words.js').then(({ since, zoneWords, local }) =>
  [since(1795767615e6), zoneWords(), local(1795767615e6)])
"""


def test_times_are_local_with_utc_beside_them(page: Browser) -> None:
    page.call("Emulation.setTimezoneOverride", timezoneId="Asia/Kolkata")
    text, zone, field = page.js(TIMES)
    assert "13:50:15" in text
    assert "(08:20:15 UTC), " in text
    assert (zone, field) == ("times in UTC+05:30", "2026-11-27T13:50:15")
    page.call("Emulation.setTimezoneOverride", timezoneId="UTC")
    text, zone, field = page.js(TIMES)
    assert ("(" in text, zone, field) == (False, "times in UTC", "2026-11-27T08:20:15")


FILTERED = """
import('/page/cards.js').then(({ Filter }) => {
  const filter = new Filter(() => 0);
  const flows = [
    { name: 'arm', status: 'Running', nodes: [{ node: 'camera' }] },
    { name: 'base', status: 'Failed', nodes: [] },
  ];
  return ['', 'CAM', 'fail', 'arm run', 'arm fail'].map((text) => {
    filter.text.value = text;
    filter.show(6, 1);
    return [filter.of(flows).map(({ name }) => name).join(), filter.text.checkVisibility()];
  });
})
"""
WAITS = """
import('/page/waits.js').then(({ Waits }) => {
  let count = 0;
  const waits = new Waits(() => { count += 1; });
  const history = (cpu) => ({ of: () => ({ waits: { cpu, io: 7 } }) });
  waits.show({ uuid: 'u', nodes: [] }, history(12));
  const few = [waits.node.textContent, count];
  waits.show({ uuid: 'u', nodes: [] }, history(40));
  waits.show({ uuid: 'u', nodes: [] }, history(40));
  waits.take({ waits: ['<b>a</b> waited 40%'], remedies: ['move it'] });
  return [...few, count, waits.node.textContent, waits.node.querySelectorAll('b').length];
})
"""
ACTIONS = """
import('/page/why.js').then(({ Why }) => {
  const asked = [];
  const why = new Why(() => 0, (action) => asked.push(action));
  const remedies = REMEDIES;
  why.show({ why: {
    name: 'robot', status: 'Failed', summary: 'x', node: '', last_lines: [], timeline: [], remedies,
    starved: [], restart_history: [], details: {}, at_us: 1,
  } });
  for (const one of why.node.querySelectorAll('[data-action]')) one.click();
  return asked;
})
"""


def test_many_are_filtered(page: Browser) -> None:
    assert page.js(FILTERED) == [
        ["arm,base", True],
        ["arm", True],
        ["base", True],
        ["arm", True],
        ["", True],
    ]


def test_waits_are_explained(page: Browser) -> None:
    text, count, more, long, marked = page.js(WAITS)
    assert "waited for a CPU 12\xa0% of the time, for a disk 7\xa0%" in text
    assert (count, more) == (0, 1), "the gateway is asked once, and only for long waits"
    assert "<b>a</b> waited 40%move it" in long
    assert marked == 0


@pytest.mark.parametrize(
    ("remedies", "actions"),
    [
        ([], []),
        (["fix a, then run: doractl restart robot"], ["start"]),
        (["fix a, then run: doractl start /srv/robot/dataflow.yml --name robot"], ["start"]),
        (["doractl rollback robot; or doractl stop robot does"], ["rollback", "stop"]),
        (["doractl logs robot --node a", "doractl restart other"], []),
        (["doractl reload robot --node a"], []),
    ],
)
def test_remedies_are_buttons(page: Browser, remedies: list[str], actions: list[str]) -> None:
    assert page.js(ACTIONS.replace("REMEDIES", json.dumps(remedies))) == actions


LAST = """
import('/page/why.js').then(({ Why }) => {
  const why = new Why(() => 0);
  const lines = LINES.map((text) => ({ at_us: 1, node: 'cam', text }));
  why.show({ why: {
    status: 'Failed', summary: 'x', node: 'cam', last_lines: lines, timeline: [], remedies: [],
    starved: [], restart_history: [], details: {}, at_us: 1,
  } });
  return why.node.querySelector('.words h3').textContent;
})
"""


def test_the_last_lines_are_counted(page: Browser) -> None:
    assert page.js(LAST.replace("LINES", json.dumps(["a"]))) == "The last line of cam"
    assert page.js(LAST.replace("LINES", json.dumps(["a", "b"]))) == "The last 2 lines of cam"


LAYOUT = """
(async () => {
  const { layOut } = await import("/page/layers.js");
  const wrong = [];
  let seed = 7;
  const random = (below) => (seed = (seed * 48271) % 2147483647) % below;
  for (let round = 0; round < 200; round += 1) {
    const count = 1 + random(12);
    const nodes = Array.from({ length: count }, (_, at) =>
      ({ id: `n${at}`, length: 60 + random(90), breadth: 40 + random(30) }));
    const edges = Array.from({ length: random(20) }, () =>
      ({ from: `n${random(count)}`, to: `n${random(count + 1)}` }));
    const plan = layOut(nodes, edges, 50);
    const places = [...plan.places.values()];
    for (const a of places) {
      if (!(a.along >= 0 && a.across >= 0 && a.along <= plan.length && a.across <= plan.breadth)) {
        wrong.push([round, a.id, "outside"]);
      }
      for (const b of places) {
        if (a.id < b.id && Math.abs(a.along - b.along) < (a.length + b.length) / 2 - 1 &&
            Math.abs(a.across - b.across) < (a.breadth + b.breadth) / 2 - 1) {
          wrong.push([round, a.id, b.id]);
        }
      }
    }
    for (const [edge, way] of plan.ways) {
      if (way[0].id !== edge.from || way.at(-1).id !== edge.to) wrong.push([round, edge]);
      const steps = way.slice(1).map((place, at) => place.layer - way[at].layer);
      if (steps.some((step) => step !== (plan.back.has(edge) ? -1 : 1))) wrong.push([round, "way"]);
    }
  }
  return wrong;
})()
"""


def test_no_two_nodes_in_one_place(page: Browser) -> None:
    """Two hundred graphs, with circles, loops and edges from nowhere."""
    assert page.js(LAYOUT) == []


KEPT = """
(async () => {
  const { Graph } = await import("/page/graph.js");
  const graph = new Graph(() => 0);
  document.body.append(graph.node);
  const box = () => graph.node.querySelector("[data-node=a]");
  const show = (...ids) => graph.show({ nodes: ids.map((id) => ({ id, kind: "python" })) });
  show("a");
  const first = box();
  show("a");
  const isKept = box() === first;
  show("a", "b");
  return [isKept, box() !== first, graph.boxes.size];
})()
"""


def test_the_same_graph_keeps_its_boxes(page: Browser) -> None:
    """A mouse button goes down and up over the same box."""
    assert page.js(KEPT) == [True, True, 2]
