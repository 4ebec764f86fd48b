// The list of all dataflows: those that systemd has loaded, and those that have ended.

import { el, say } from "./dom.js";
import { newest } from "./history.js";
import { cpuChart, memoryChart, showState, showUse } from "./parts.js";
import { bytes, isUp, percent, plural, since, uptime } from "./words.js";

const MANY = 5;
const NEARLY_FULL = 0.1;

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

const by = (id) => document.getElementById(id);

/** Those of the dataflows that have all words of the filter, which is there if they are many. */
export class Filter {
  constructor(onChange) {
    this.text = by("filter-text");
    this.text.oninput = onChange;
  }

  /** all: as many as there are, shown or not. */
  show(all, shown) {
    by("filter").hidden = all <= MANY && !this.text.value;
    say(by("filtered"), this.text.value ? `${shown} of ${plural(all, "dataflow")}` : "");
    by("filtered").hidden = !this.text.value;
  }

  of(flows) {
    const words = this.text.value.toLowerCase().split(/\s+/);
    return flows.filter((flow) => {
      const parts = [flow.name, flow.status, flow.release, flow.uuid, flow.text,
        ...(flow.nodes ?? []).map(({ node }) => node)];
      const text = parts.join("\n").toLowerCase();
      return words.every((word) => text.includes(word));
    });
  }
}

/** What the whole machine uses. before: the numbers of the snapshot before, or null. */
export function hostWords(host, before) {
  const found = [];
  const all = before ? host.ticks - before.ticks : 0;
  const busy = all > 0 ? (100 * (host.busy_ticks - before.busy_ticks)) / all : null;
  if (busy != null) found.push([`CPU ${percent(busy * host.cpus)} of ${percent(100 * host.cpus)}`, busy > 90]);
  if (host.memory_bytes) {
    const left = host.memory_available_bytes / host.memory_bytes;
    found.push([`memory ${bytes(host.memory_bytes - host.memory_available_bytes)} of ${
      bytes(host.memory_bytes)}`, left < NEARLY_FULL]);
  }
  if (host.disk_bytes) {
    found.push([`disk ${bytes(host.disk_free_bytes)} free on ${host.disk}`,
      host.disk_free_bytes / host.disk_bytes < NEARLY_FULL]);
  }
  return found;
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
