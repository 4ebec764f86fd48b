// What dataflows and nodes are shown with: charts, badges and facts.

import { Chart } from "./chart.js";
import { el, say } from "./dom.js";
import { bytes, percent, titled, tone } from "./words.js";

const LEAST_CPU = 10;
const LEAST_MEMORY = 1 << 20;

export const cpuChart = (className = "") => new Chart("CPU", percent, className);
export const memoryChart = (className = "") => new Chart("Memory", bytes, `memory ${className}`);

/** Both graphs of a group with its limits; none of what has no numbers. */
export function showUse(charts, history, facts) {
  const { times } = history;
  charts.cpu.show(history.cpu, times, facts.cpu_limit_percent ?? null, LEAST_CPU);
  charts.memory.show(history.memory, times, facts.memory_limit_bytes ?? null, LEAST_MEMORY);
  for (const { node } of Object.values(charts)) node.hidden = !history.cpu.length;
}

/** Sets state and colour of a badge. */
export function showState(badge, state) {
  say(badge, titled(state));
  badge.dataset.tone = tone(state);
}

/** Facts by name, shown where there is something to show. */
export class Facts {
  constructor() {
    this.known = new Map();
    this.node = el("dl");
  }

  show(name, text) {
    if (!this.known.has(name)) {
      const value = el("dd");
      const node = el("div", {}, el("dt", { class: "muted" }, name), value);
      this.known.set(name, { value, node });
      this.node.append(node);
    }
    const { value, node } = this.known.get(name);
    node.hidden = !text;
    say(value, text ?? "");
  }
}
