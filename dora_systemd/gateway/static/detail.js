// One dataflow: why it failed, what it is, what it uses, how it is wired, its nodes and their logs.

import { Buttons } from "./actions.js";
import { arrange, el, say } from "./dom.js";
import { Graph } from "./graph.js";
import { Logs } from "./logs.js";
import { NodeRow } from "./nodes.js";
import { Facts, cpuChart, memoryChart, showState, showUse } from "./parts.js";
import { Bundles } from "./past/bundles.js";
import { Pictures } from "./past/pictures.js";
import { Releases } from "./past/releases.js";
import { Timeline } from "./past/timeline.js";
import { Waits } from "./waits.js";
import { Why } from "./why.js";
import { bytes, containerWords, isUp, outside, since, uptime } from "./words.js";

const LIMITS = {
  memory_limit: "memory", memory_high: "memory high", swap_limit: "swap", cpu_limit: "CPU",
  tasks_limit: "tasks", cpu_weight: "CPU weight", io_weight: "IO weight",
};

const limitWords = (facts) => [
  ...Object.keys(LIMITS).filter((key) => facts[key]).map((key) => `${LIMITS[key]} ${facts[key]}`),
  ...(facts.nodes ?? []),
].join(", ") || "none";

const inhibitorWords = ({ node, pid, user, why }) =>
  `${node ? `node ${node}` : `PID ${pid ?? "unknown"}, user ${user ?? "unknown"}`}${why ? `: ${why}` : ""}`;

/** The last release that has failed its trial, as far as the journal has it for this life. */
function undoneWords(why) {
  const last = why?.timeline.findLast(({ event }) => event === "release-rolled-back");
  return last ? `${last.text}, ${since(last.at_us)}` : "";
}

/** The containers for which no limit of a node holds, and which no stop of the dataflow ends. */
const outsideWords = (nodes) => outside(nodes).map(containerWords).join(", ");

const sandboxWords = ({ sandbox, network }) =>
  (network === "host" ? sandbox : `${sandbox}, network ${network}`);

export class Detail {
  /** ask: is called with an action, and a node or "". send: takes a message to the gateway. */
  constructor(uuid, ask, send) {
    this.uuid = uuid;
    this.ask = ask;
    this.send = (message) => send({ ...message, dataflow: uuid });
    this.chosen = "";
    this.rows = new Map();
    this.title = el("h1");
    this.badge = el("span", { class: "badge large" });
    this.text = el("p", { class: "text muted" });
    this.buttons = new Buttons(ask);
    this.facts = new Facts();
    this.charts = { cpu: cpuChart(), memory: memoryChart() };
    this.waits = new Waits(() => this.send({ type: "waits" }));
    const choose = (node) => this.#choose(node);
    this.why = new Why((node) => this.follow(node), ask);
    this.graph = new Graph(choose);
    this.nodes = el("ul", { class: "nodes" });
    this.releases = new Releases((release) => ask("rollback", "", release));
    // A new bundle is an event of the timeline.
    const askPast = () => {
      this.send({ type: "timeline" });
      this.send({ type: "bundles" });
    };
    this.timeline = new Timeline(askPast, (at) => this.#showLog(at));
    this.pictures = new Pictures(uuid);
    this.bundles = new Bundles(this.buttons.all.bundle);
    this.logs = new Logs((node) => this.follow(node), this.send);
    const panel = (title, label, node) => el("section", { class: "panel", "aria-label": label },
      el("div", { class: "head" }, el("h2", {}, title)), node);
    this.panels = [panel("Dataflow", "Graph of the dataflow", this.graph.node),
      panel("Nodes", "Nodes", this.nodes)];
    this.node = el("article", {},
      el("a", { href: "#", class: "return" }, "‹ All dataflows"),
      el("div", { class: "title" },
        el("div", {}, el("div", { class: "line" }, this.title, this.badge), this.text),
        this.buttons.node),
      this.why.node, this.facts.node,
      el("div", { class: "charts" }, this.charts.cpu.node, this.charts.memory.node),
      this.waits.node, this.timeline.node, this.pictures.node, ...this.panels, this.releases.node,
      this.bundles.node, this.logs.node);
  }

  /** Asks for what comes once: after each connection. */
  begin() {
    this.send({ type: "graph" });
    this.asks = 2;
    this.releases.isDue = this.timeline.isDue = this.pictures.isDue = true;
    this.logs.begin(this.chosen);
  }

  #showLog(at) {
    if (this.chosen) this.follow("");
    this.logs.showAt(at);
  }

  /** A click on a node shows its logs, another one those of all. */
  #choose(node) {
    this.follow(this.chosen === node ? "" : node);
  }

  follow(node) {
    this.chosen = node;
    this.logs.begin(node);
    if (this.flow) this.show(this.flow, this.history, this.isFree);
  }

  /** What is known of it besides its numbers. */
  learn(about) {
    this.about = about;
    this.why.show(about);
    if (this.flow) this.show(this.flow, this.history, this.isFree);
  }

  /** After an action. */
  acted() {
    say(this.buttons.pending, "");
    this.timeline.askedAt = 0;
    this.askAbout();
  }

  askAbout() {
    this.send({ type: "about" });
    this.releases.isDue = this.timeline.isDue = this.pictures.isDue = true;
  }

  show(flow, history, isFree) {
    this.#askAgain(flow);
    Object.assign(this, { flow, history, isFree });
    const shown = this.#withEnd(flow);
    this.logs.name = flow.name;
    say(this.title, flow.name);
    showState(this.badge, flow.status);
    // Below, it is what why says.
    say(this.text, this.why.node.hidden ? flow.text : "");
    this.why.tick(isFree);
    const own = history.of(flow.uuid);
    showUse(this.charts, own, flow);
    this.waits.show(flow, history);
    this.timeline.show(flow, history.longOf(flow.uuid));
    this.#showFacts(shown);
    this.#showNodes(shown, isFree && isUp(flow));
    this.buttons.show(flow, this.about, isFree);
    this.releases.show(flow, isFree);
    this.bundles.show(flow);
    this.pictures.show(flow);
  }

  /** Another state has another reason, and another run may have other nodes and wires. */
  #askAgain(flow) {
    if (flow === this.flow) return;
    const news = JSON.stringify([flow.status, flow.text, flow.restarts, flow.ready_us,
      flow.release]);
    // Twice, because the journal may be behind.
    if (news !== this.news) this.asks = 2;
    if (this.asks > 0) {
      this.asks -= 1;
      this.askAbout();
    }
    if (flow.release && this.releases.isNext()) this.send({ type: "releases" });
    if (this.flow && this.flow.ready_us !== flow.ready_us) this.send({ type: "graph" });
    this.news = news;
  }

  /** One that has ended has no table any more; its nodes are in the journal. */
  #withEnd(flow) {
    const row = this.about?.row;
    return isUp(flow) || !row || isUp(row) ? flow : { ...flow, ...row };
  }

  #showNodes(flow, isFree) {
    const names = flow.nodes.map((node) => node.node);
    arrange(this.nodes, this.rows, names, (name) =>
      new NodeRow(name, this.ask, (node) => this.#choose(node)));
    for (const node of flow.nodes) {
      const row = this.rows.get(node.node);
      row.show(node, this.history.of(flow.uuid, node.node), node.node === this.chosen, isFree);
    }
    this.graph.mark(flow.nodes, this.chosen, isUp(flow) || !this.about?.why ? "unknown" : "stopped");
    const [graph, list] = this.panels;
    graph.hidden = Boolean(flow.isEnded && this.graph.isEmpty);
    list.hidden = !names.length;
    this.logs.offer(names);
  }

  #showFacts(flow) {
    const { facts } = this;
    const up = isUp(flow);
    const known = this.about?.facts ?? {};
    const row = this.about?.row;
    const alive = `${flow.nodes_alive} of ${flow.nodes_total}`;
    facts.show("Uptime", up && flow.uptime_us != null ? uptime(flow.uptime_us) : "");
    facts.show("Ended", !up && flow.ended_us ? since(flow.ended_us) : "");
    facts.show("Nodes", flow.nodes_total ? (up ? alive : String(flow.nodes_total)) : flow.problem);
    facts.show("Machines", flow.machines?.length ? ["head", ...flow.machines].join(", ") : "");
    facts.show("Restarts", flow.restarts == null ? "" : String(flow.restarts));
    facts.show("Peak memory", flow.memory_peak_bytes == null ? "" : bytes(flow.memory_peak_bytes));
    facts.show("Outside", up ? outsideWords(flow.nodes) : "");
    const isKnown = known.sandbox != null;
    facts.show("Limits", isKnown ? limitWords(known) : "");
    facts.show("Hot reload", isKnown ? (known.hot_reload ? "on" : "off") : "");
    facts.show("Sandbox", isKnown ? sandboxWords(known) : "");
    facts.show("At boot", isKnown && row ? (row.enabled ? "started" : "not started") : "");
    facts.show("Inhibited", (row?.inhibitors ?? []).map(inhibitorWords).join("; "));
    facts.show("Release", flow.release ?? "");
    facts.show("Rolled back", undoneWords(this.about?.why));
    facts.show("Unit", flow.unit);
    facts.show("UUID", flow.uuid);
    facts.show("File", flow.file);
  }
}
