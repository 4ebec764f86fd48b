// The status page: what comes from the gateway goes to the list and to the dataflow that is chosen.

import { askFirst, doing, tell } from "./actions.js";
import { Card, Filter, hostWords, totals } from "./cards.js";
import { Detail } from "./detail.js";
import { arrange, el, say } from "./dom.js";
import { History } from "./history.js";
import { Link } from "./link.js";
import { byNeed } from "./words.js";

const by = (id) => document.getElementById(id);
const history = new History();
const cards = new Map();
const endedCards = new Map();
const actions = new Map();
let flows = [];
let ended = null;
let isKnown = false;
let detail = null;
let kept = "";
let number = 0;

let hostBefore = null;
const link = new Link(take, showLink);
const filter = new Filter(() => show());

const TAKERS = {
  hello: begin,
  snapshot: ({ dataflows, host }) => {
    showHost(host ?? {});
    update(dataflows);
  },
  ended: showEnded,
  graph: (message) => detail?.graph.show(message),
  about: (message) => detail?.learn(message),
  releases: (message) => detail?.releases.take(message),
  timeline: (message) => detail?.timeline.take(message),
  bundles: (message) => detail?.bundles.take(message),
  waits: (message) => detail?.waits.take(message),
  lines: (message) => detail?.logs.take(message),
  found: (message) => detail?.logs.take(message),
  file: (message) => detail?.logs.take(message),
  acted,
  problem: showProblem,
};

// Answers about the dataflow that was chosen when they were asked for.
const OWN = ["graph", "about", "releases", "timeline", "waits", "bundles"];

function take(message) {
  const isForeign = OWN.includes(message.type) && message.dataflow !== detail?.uuid;
  if (!isForeign) TAKERS[message.type]?.(message);
}

function begin({ host, scope }) {
  say(by("place"), `${host} · ${scope === "system" ? "system" : `of ${scope}`}`);
  document.title = `dora on ${host}`;
  // What was asked of the gateway before gets no answer any more.
  actions.clear();
  if (detail) say(detail.buttons.pending, "");
  link.send({ type: "ended" });
  detail?.begin();
}

function update(dataflows) {
  const isOneLost = flows.some(({ uuid }) => !dataflows.some((one) => one.uuid === uuid));
  const isOneNew = dataflows.some(({ name }) => ended?.some((one) => one.name === name));
  if (isOneLost || isOneNew) link.send({ type: "ended" });
  flows = dataflows.sort(byNeed);
  isKnown = true;
  by("problem").hidden = true;
  history.add(flows);
  choose();
  show();
}

function showEnded({ dataflows = [] }) {
  ended = dataflows.map((flow) => ({ ...flow, isEnded: true }));
  show();
}

const flowOf = (uuid) => [...flows, ...ended ?? []].find((one) => one.uuid === uuid);

/** The address has it; without one, what was chosen before, or on a wide screen the first. */
function chosenUuid() {
  const isWide = matchMedia("(min-width: 960px)").matches;
  return location.hash.slice(1) || kept || (isWide && flows.length ? flows[0].uuid : "");
}

function choose() {
  const uuid = chosenUuid();
  kept = uuid;
  if (uuid === (detail?.uuid ?? "")) return;
  detail = uuid ? new Detail(uuid, ask, (message) => link.send(message)) : null;
  by("detail").replaceChildren(...(detail ? [detail.node] : []));
  document.body.dataset.view = detail ? "detail" : "list";
  if (detail) detail.begin();
  else link.send({ type: "unfollow" });
}

function show() {
  const [some, gone] = [filter.of(flows), filter.of(ended ?? [])];
  filter.show(flows.length + (ended?.length ?? 0), some.length + gone.length);
  showCards(by("list"), cards, some);
  showCards(by("ended-list"), endedCards, gone);
  by("ended").hidden = !gone.length;
  say(by("ended-title"), `Ended (${gone.length})`);
  if (detail) showDetail(flowOf(detail.uuid));
  const words = totals(flows, history).map((word) => el("span", {}, word));
  by("totals").replaceChildren(...words);
  showNothing();
}

function showHost(host) {
  const words = hostWords(host, hostBefore).map(([text, isBad]) =>
    el("span", { class: isBad ? "scarce" : null }, text));
  by("host").replaceChildren(el("span", {}, "this machine:"), ...words);
  hostBefore = host;
}

function showCards(parent, known, shown) {
  arrange(parent, known, shown.map((flow) => flow.uuid), (uuid) => new Card(uuid));
  for (const flow of shown) known.get(flow.uuid).show(flow, history, flow.uuid === detail?.uuid);
}

function showDetail(flow) {
  by("gone")?.remove();
  detail.node.hidden = !flow && !detail.flow;
  if (flow) {
    detail.show(flow, history, link.isLive && ![...actions.values()].includes(flow.uuid));
  } else if (isKnown && ended) {
    detail.node.hidden = true;
    by("detail").prepend(el("div", { id: "gone", class: "none" },
      el("h1", {}, `${detail.flow?.name ?? "This dataflow"} is no longer there`),
      el("p", {}, "It has ended, and systemd has unloaded it. The journal may still have its logs:"),
      el("pre", {}, `doractl logs ${detail.flow?.name ?? detail.uuid}`),
      el("p", {}, el("a", { href: "#", class: "back" }, "All dataflows"))));
  }
}

function showNothing() {
  by("none")?.remove();
  if (flows.length || !isKnown || detail) return;
  document.querySelector("main").prepend(el("div", { id: "none", class: "none" },
    el("h1", {}, "No dataflow is running"),
    el("p", {}, "Start one on this machine, and it appears here:"),
    el("pre", {}, "doractl start dataflow.yml")));
}

function showLink(state, wait = 0) {
  const pill = by("link");
  pill.dataset.state = state;
  const seconds = Math.max(1, Math.round(wait / 1000));
  say(pill, state === "disconnected" ? `disconnected, next try in ${seconds} s` : state);
  by("again").hidden = state !== "disconnected";
  document.body.classList.toggle("stale", state !== "live");
  if (state === "disconnected") {
    showProblem({ text: "No connection to the gateway: this is what was known last.",
      hint: "if somebody has stopped it, run: doractl up" });
  }
  if (state !== "live") show();
}

function showProblem({ text, hint }) {
  const node = by("problem");
  say(node, hint ? `${text} (${hint})` : text);
  node.hidden = false;
}

function ask(action, node, release) {
  const flow = flowOf(detail.uuid);
  const facts = detail.about?.facts ?? {};
  askFirst(action, node, flow, facts, (...done) => act(flow, ...done), release);
}

function act(flow, action, node, values, release = "") {
  number += 1;
  actions.set(number, flow.uuid);
  link.send({ type: "act", action, dataflow: flow.uuid, node, number, values, release });
  if (detail?.uuid === flow.uuid) say(detail.buttons.pending, doing(action, node || flow.name));
  show();
}

function acted(message) {
  const uuid = actions.get(message.number);
  actions.delete(message.number);
  if (detail && detail.uuid === uuid) detail.acted();
  tell(message);
  show();
}

function leave() {
  kept = "";
  // The address may be without a dataflow already.
  choose();
  show();
}

addEventListener("hashchange", () => {
  kept = "";
  choose();
  show();
  if (detail) by("detail").focus({ preventScroll: true });
  scrollTo(0, 0);
});
by("detail").addEventListener("click", ({ target }) => {
  if (target.closest(".return, .back") && !location.hash.slice(1)) leave();
});
by("again").addEventListener("click", () => link.connect());
link.connect();
