// One dataflow: what it is, what it uses, how it is wired, its nodes and what they write.

import { Chart } from "./chart.js";
import { arrange, el, say } from "./dom.js";
import { Graph } from "./graph.js";
import { newest, waitWords } from "./history.js";
import { Logs } from "./logs.js";
import { bytes, isUp, percent, plural, titled, tone, uptime } from "./words.js";

const LEAST_CPU = 10;
const LEAST_MEMORY = 1 << 20;
const ALIVE = ["ready", "running", "dynamic"];

export const cpuChart = (className = "") => new Chart("CPU", percent, className);
export const memoryChart = (className = "") => new Chart("Memory", bytes, `memory ${className}`);

/** Both graphs of a group with its limits. */
export function showUse(charts, history, facts) {
  charts.cpu.show(history.cpu, facts.cpu_limit_percent ?? null, LEAST_CPU);
  charts.memory.show(history.memory, facts.memory_limit_bytes ?? null, LEAST_MEMORY);
}

/** Sets state and colour of a badge. */
export function showState(badge, state) {
  say(badge, titled(state));
  badge.dataset.tone = tone(state);
}

const fact = (name) => {
  const value = el("dd");
  return { value, node: el("div", {}, el("dt", { class: "muted" }, name), value) };
};

class NodeRow {
  constructor(name, ask, choose) {
    this.badge = el("span", { class: "badge" });
    this.exit = el("span", { class: "exit" });
    this.up = el("span", { class: "up" });
    this.restarts = el("span", { class: "restarts" });
    this.charts = { cpu: cpuChart("small"), memory: memoryChart("small") };
    this.waits = el("span", { class: "waits" });
    const act = (action, text) => el("button", { type: "button", class: "small",
      "aria-label": `${text} ${name}`, onclick: () => ask(action, name) }, text);
    this.buttons = { restart: act("restart", "Restart"), stop: act("stop", "Stop") };
    this.choose = el("button", { type: "button", class: "plain name", "aria-pressed": "false",
      title: `Show the logs of ${name}`, onclick: () => choose(name) }, name);
    this.node = el("li", { "data-node": name },
      el("div", { class: "what" }, this.choose, this.badge, this.exit),
      el("div", { class: "facts muted" }, this.up, this.restarts, this.waits),
      this.charts.cpu.node, this.charts.memory.node,
      el("div", { class: "buttons" }, this.buttons.restart, this.buttons.stop));
  }

  show(facts, history, isChosen, isFree) {
    showState(this.badge, facts.state);
    const isAlive = ALIVE.includes(facts.state);
    say(this.exit, isAlive ? "" : facts.exit);
    const since = facts.since_us ? Date.now() * 1000 - facts.since_us : null;
    say(this.up, isAlive ? `up ${uptime(since)}` : "");
    say(this.restarts, facts.restarts ? plural(facts.restarts, "restart") : "");
    say(this.waits, waitWords(history.waits));
    showUse(this.charts, history, facts);
    this.choose.setAttribute("aria-pressed", String(isChosen));
    this.buttons.restart.disabled = !isFree || !isAlive;
    this.buttons.stop.disabled = !isFree || !isAlive;
  }
}

export class Detail {
  /** ask: is called with an action, and a node or "". send: takes a message to the gateway. */
  constructor(uuid, ask, send) {
    this.uuid = uuid;
    this.ask = ask;
    this.send = send;
    this.chosen = "";
    this.number = 0;
    this.rows = new Map();
    this.title = el("h1");
    this.badge = el("span", { class: "badge large" });
    this.text = el("p", { class: "text muted" });
    this.pending = el("span", { class: "pending muted", role: "status" });
    const act = (action, text) =>
      el("button", { type: "button", "data-action": action, onclick: () => ask(action, "") }, text);
    this.buttons = { restart: act("restart", "Restart"), stop: act("stop", "Stop") };
    this.facts = Object.fromEntries(
      ["Uptime", "Nodes", "Restarts", "Peak memory", "UUID", "File"].map((n) => [n, fact(n)]));
    this.charts = { cpu: cpuChart(), memory: memoryChart() };
    this.waits = el("p", { class: "waits", hidden: true });
    this.graph = new Graph((node) => this.follow(node));
    this.nodes = el("ul", { class: "nodes" });
    this.logs = new Logs((node) => this.follow(node));
    this.node = el("article", {},
      el("a", { href: "#", class: "return" }, "‹ All dataflows"),
      el("div", { class: "title" },
        el("div", {}, el("div", { class: "line" }, this.title, this.badge), this.text),
        el("div", { class: "buttons" }, this.pending, this.buttons.restart, this.buttons.stop)),
      el("dl", {}, ...Object.values(this.facts).map((one) => one.node)),
      el("div", { class: "charts" }, this.charts.cpu.node, this.charts.memory.node),
      this.waits,
      el("section", { class: "panel", "aria-label": "Graph of the dataflow" },
        el("div", { class: "head" }, el("h2", {}, "Dataflow")), this.graph.node),
      el("section", { class: "panel", "aria-label": "Nodes" },
        el("div", { class: "head" }, el("h2", {}, "Nodes")), this.nodes),
      this.logs.node);
  }

  /** Asks for what comes once: after each connection. */
  begin() {
    this.send({ type: "graph", dataflow: this.uuid });
    this.follow(this.chosen);
  }

  follow(node) {
    this.chosen = node;
    this.number += 1;
    this.logs.begin(this.number, node);
    this.send({ type: "follow", dataflow: this.uuid, node, number: this.number });
    if (this.flow) this.show(this.flow, this.history, this.isFree);
  }

  show(flow, history, isFree) {
    // Another run may have other nodes and wires.
    const isNew = this.flow && isUp(flow) && this.flow.started_us !== flow.started_us;
    Object.assign(this, { flow, history, isFree });
    if (isNew) this.send({ type: "graph", dataflow: this.uuid });
    say(this.title, flow.name);
    showState(this.badge, flow.status);
    say(this.text, flow.text);
    const own = history.of(flow.uuid);
    showUse(this.charts, own, flow);
    say(this.waits, waitWords(own.waits));
    this.waits.hidden = !this.waits.textContent;
    this.#showFacts(flow);
    const names = flow.nodes.map((node) => node.node);
    arrange(this.nodes, this.rows, names, (name) =>
      new NodeRow(name, this.ask, (chosen) => this.follow(chosen)));
    for (const node of flow.nodes) {
      const row = this.rows.get(node.node);
      row.show(node, history.of(flow.uuid, node.node), node.node === this.chosen, isFree);
    }
    this.graph.mark(flow.nodes, this.chosen);
    this.logs.offer(names);
    this.buttons.restart.disabled = !isFree;
    this.buttons.stop.disabled = !isFree || !isUp(flow);
  }

  #showFacts(flow) {
    const total = flow.nodes_total ? `${flow.nodes_alive} of ${flow.nodes_total}` : "–";
    say(this.facts.Uptime.value, uptime(flow.uptime_us));
    say(this.facts.Nodes.value, total);
    say(this.facts.Restarts.value, String(flow.restarts ?? "–"));
    say(this.facts["Peak memory"].value, bytes(flow.memory_peak_bytes));
    this.facts["Peak memory"].node.hidden = flow.memory_peak_bytes == null;
    say(this.facts.UUID.value, flow.uuid);
    say(this.facts.File.value, flow.file);
  }
}

/** The line of a dataflow in the list of all. */
export class Card {
  constructor(uuid) {
    this.name = el("strong");
    this.badge = el("span", { class: "badge" });
    this.facts = el("span", { class: "muted facts" });
    this.charts = { cpu: cpuChart("small"), memory: memoryChart("small") };
    this.node = el("a", { href: `#${uuid}`, class: "card", "data-uuid": uuid },
      el("span", { class: "line" }, this.name, this.badge), this.facts,
      this.charts.cpu.node, this.charts.memory.node);
  }

  show(flow, history, isChosen) {
    say(this.name, flow.name);
    showState(this.badge, flow.status);
    const parts = [isUp(flow) ? `up ${uptime(flow.uptime_us)}` : flow.text,
      flow.nodes_total ? `${flow.nodes_alive}/${flow.nodes_total} nodes` : "",
      flow.restarts ? plural(flow.restarts, "restart") : ""];
    say(this.facts, parts.filter(Boolean).join(" · "));
    showUse(this.charts, history.of(flow.uuid), flow);
    if (isChosen) this.node.setAttribute("aria-current", "true");
    else this.node.removeAttribute("aria-current");
  }
}

/** What all of them use together. */
export function totals(flows, history) {
  const up = flows.filter(isUp);
  const nodes = up.reduce((sum, flow) => sum + flow.nodes_alive, 0);
  const cpu = up.reduce((sum, flow) => sum + (newest(history.of(flow.uuid).cpu) ?? 0), 0);
  const memory = up.reduce((sum, flow) => sum + (flow.memory_bytes ?? 0), 0);
  return [plural(up.length, "dataflow"), plural(nodes, "node"), `CPU ${percent(cpu)}`,
    bytes(memory)];
}
