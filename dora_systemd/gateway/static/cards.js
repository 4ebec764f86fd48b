// The list of all dataflows: those that systemd has loaded, and those that have ended.

import { el, say } from "./dom.js";
import { newest } from "./history.js";
import { cpuChart, memoryChart, showState, showUse } from "./parts.js";
import { bytes, isUp, percent, plural, since, uptime } from "./words.js";

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
    const ended = flow.ended_us ? since(flow.ended_us) : "";
    const hasRun = isUp(flow) && flow.status !== "Waiting";
    // The text of a degraded one has the number of its nodes.
    const isDegraded = flow.status === "Degraded";
    const parts = [hasRun ? `up ${uptime(flow.uptime_us)}` : "",
      hasRun && !isDegraded ? "" : flow.text,
      flow.nodes_total && !isDegraded ? `${flow.nodes_alive}/${flow.nodes_total} nodes` : "",
      flow.restarts ? plural(flow.restarts, "restart") : "", ended,
      flow.release ? `release ${flow.release}` : ""];
    say(this.facts, parts.filter(Boolean).join(" · "));
    showUse(this.charts, history.of(flow.uuid), flow);
    if (isChosen) this.node.setAttribute("aria-current", "true");
    else this.node.removeAttribute("aria-current");
  }
}

/** What all of them use together, after how many need a hand. */
export function totals(flows, history) {
  const up = flows.filter(isUp);
  const nodes = up.reduce((sum, flow) => sum + flow.nodes_alive, 0);
  const cpu = up.reduce((sum, flow) => sum + (newest(history.of(flow.uuid).cpu) ?? 0), 0);
  const memory = up.reduce((sum, flow) => sum + (flow.memory_bytes ?? 0), 0);
  const count = (status) => flows.filter((flow) => flow.status === status).length;
  const bad = ["Failed", "Degraded"].filter(count)
    .map((status) => `${count(status)} ${status.toLowerCase()}`);
  return [...bad, plural(flows.length, "dataflow"), plural(nodes, "node"), `CPU ${percent(cpu)}`,
    bytes(memory)];
}
