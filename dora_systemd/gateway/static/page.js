// The status page: what comes from the gateway goes to the list and to the dataflow that is chosen.

import { Card, Detail, totals } from "./detail.js";
import { arrange, el, say } from "./dom.js";
import { History } from "./history.js";
import { Link } from "./link.js";

const SAID_MS = 8000;

const by = (id) => document.getElementById(id);
const history = new History();
const cards = new Map();
const actions = new Map();
let flows = [];
let isKnown = false;
let detail = null;
let number = 0;

const link = new Link(take, showLink);

function take(message) {
  if (message.type === "hello") begin(message);
  else if (message.type === "snapshot") update(message.dataflows);
  else if (message.type === "graph" && message.dataflow === detail?.uuid) detail.graph.show(message);
  else if (message.type === "lines") detail?.logs.add(message);
  else if (message.type === "acted") acted(message);
  else if (message.type === "problem") showProblem(message);
}

function begin({ host, scope }) {
  say(by("place"), `${host} · ${scope === "system" ? "system" : `of ${scope}`}`);
  document.title = `dora on ${host}`;
  actions.clear();
  detail?.begin();
}

function update(dataflows) {
  flows = dataflows;
  isKnown = true;
  by("problem").hidden = true;
  history.add(flows);
  choose();
  show();
}

function chosenUuid() {
  const wanted = location.hash.slice(1);
  if (flows.some((flow) => flow.uuid === wanted)) return wanted;
  const isWide = matchMedia("(min-width: 960px)").matches;
  return isWide && flows.length ? flows[0].uuid : "";
}

function choose() {
  const uuid = chosenUuid();
  if (uuid === (detail?.uuid ?? "")) return;
  detail = uuid ? new Detail(uuid, ask, (message) => link.send(message)) : null;
  by("detail").replaceChildren(...(detail ? [detail.node] : []));
  document.body.dataset.view = detail ? "detail" : "list";
  if (detail) detail.begin();
  else link.send({ type: "unfollow" });
}

function show() {
  arrange(by("list"), cards, flows.map((flow) => flow.uuid), (uuid) => new Card(uuid));
  for (const flow of flows) cards.get(flow.uuid).show(flow, history, flow.uuid === detail?.uuid);
  const flow = flows.find((one) => one.uuid === detail?.uuid);
  if (flow) {
    detail.show(flow, history, link.isLive && ![...actions.values()].includes(flow.uuid));
  }
  const words = totals(flows, history).map((word) => el("span", {}, word));
  by("totals").replaceChildren(...words);
  showNothing();
}

function showNothing() {
  by("none")?.remove();
  if (flows.length || !isKnown) return;
  by("list").before(el("div", { id: "none", class: "none" },
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
  if (state !== "live") show();
}

function showProblem({ text, hint }) {
  const node = by("problem");
  say(node, hint ? `${text} (${hint})` : text);
  node.hidden = false;
}

const CONSEQUENCES = {
  stop: ["Stop", "Its nodes are told to stop; those still running after the grace duration are killed."],
  restart: ["Restart", "All nodes stop and start again; name, UUID and settings stay."],
  "stop node": ["Stop", "It stays down until the dataflow is restarted; the other nodes keep running."],
  "restart node": ["Restart", "The other nodes keep running."],
};

function ask(action, node) {
  const flow = flows.find((one) => one.uuid === detail.uuid);
  const [word, consequence] = CONSEQUENCES[node ? `${action} node` : action];
  say(by("question"), `${word} ${node ? `node ${node} of ${flow.name}` : flow.name}?`);
  say(by("consequence"), consequence);
  say(by("confirmed"), word);
  by("confirmed").dataset.action = action;
  const dialog = by("confirm");
  dialog.returnValue = "";
  dialog.onclose = () => {
    if (dialog.returnValue === "yes") act(action, flow, node);
  };
  dialog.showModal();
}

function act(action, flow, node) {
  number += 1;
  actions.set(number, flow.uuid);
  link.send({ type: "act", action, dataflow: flow.uuid, node, number });
  const doing = action === "stop" ? "stopping" : "restarting";
  if (detail?.uuid === flow.uuid) say(detail.pending, `${doing} ${node || flow.name} …`);
  show();
}

function acted({ number: done, text, problem, hint }) {
  actions.delete(done);
  if (detail) say(detail.pending, "");
  const note = el("p", { class: problem ? "toast bad" : "toast" },
    problem ? [problem, hint].filter(Boolean).join(" – ") : text);
  by("said").append(note);
  setTimeout(() => note.remove(), SAID_MS);
  show();
}

addEventListener("hashchange", () => {
  choose();
  show();
  if (detail) by("detail").focus({ preventScroll: true });
  scrollTo(0, 0);
});
by("again").addEventListener("click", () => link.connect());
link.connect();
