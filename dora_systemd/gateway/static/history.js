// The last minutes of every dataflow and node. The gateway keeps none: what is a share of time is
// computed here, from two snapshots.

export const KEPT = 150;
export const SLOW_US = 10e6;
const SLOW_KEPT = 8640;
const WORTH = 5;

const series = () => ({ cpu: [], memory: [], times: [], waits: {} });

export class History {
  constructor() {
    this.last = new Map();
    this.groups = new Map();
    this.slow = new Map();
  }

  /** The most that a dataflow has used in each ten seconds since the page was opened. */
  longOf(uuid) {
    return this.slow.get(uuid) ?? [];
  }

  /** What is known of one group: its series, oldest first. */
  of(uuid, node = "") {
    return this.groups.get(`${uuid} ${node}`) ?? series();
  }

  /** Takes one snapshot in. */
  add(dataflows) {
    const seen = new Set();
    for (const flow of dataflows) {
      const before = this.last.get(flow.uuid);
      for (const [node, counters] of Object.entries(flow.groups)) {
        const key = `${flow.uuid} ${node}`;
        const facts = node ? flow.nodes.find((one) => one.node === node) : flow;
        seen.add(key);
        this.#note(key, facts, counters, before?.groups[node], flow.monotonic_us - (before?.monotonic_us ?? 0));
      }
      this.last.set(flow.uuid, flow);
    }
    for (const key of this.groups.keys()) if (!seen.has(key)) this.groups.delete(key);
    const known = new Set(dataflows.map((flow) => flow.uuid));
    for (const uuid of this.last.keys()) if (!known.has(uuid)) this.last.delete(uuid);
  }

  #note(key, facts, now, before, window) {
    if (!facts) return;
    const kept = this.groups.get(key) ?? series();
    // A counter that went down belongs to another run; that of another machine is not sent.
    const isSame = before && window > 0 && now.cpu_us !== null && now.cpu_us >= before.cpu_us;
    const share = (from, to) => (100 * Math.max(to - from, 0)) / window;
    kept.cpu.push(isSame ? share(before.cpu_us, now.cpu_us) : facts.cpu_percent ?? 0);
    kept.memory.push(facts.memory_bytes ?? 0);
    kept.times.push(Date.now() * 1000);
    kept.waits = isSame ? this.#waits(now, before, share) : {};
    for (const list of [kept.cpu, kept.memory, kept.times]) if (list.length > KEPT) list.shift();
    this.groups.set(key, kept);
    if (key.endsWith(" ")) this.#keepLong(key.trim(), newest(kept.cpu), newest(kept.memory));
  }

  #keepLong(uuid, cpu, memory) {
    const at = Math.floor((Date.now() * 1000) / SLOW_US) * SLOW_US;
    const points = this.longOf(uuid);
    const last = points.at(-1);
    if (last?.at === at) Object.assign(last, { cpu: Math.max(last.cpu, cpu), memory: Math.max(last.memory, memory) });
    else points.push({ at, cpu, memory });
    if (points.length > SLOW_KEPT) points.shift();
    this.slow.set(uuid, points);
  }

  #waits(now, before, share) {
    const found = Object.entries(now.stalled_us).map(([resource, us]) =>
      [resource, share(before.stalled_us[resource] ?? 0, us)]);
    const periods = now.periods - before.periods;
    const throttled = now.throttled_periods - before.throttled_periods;
    if (periods > 0 && throttled > 0) found.push(["its CPU limit", (100 * throttled) / periods]);
    return Object.fromEntries(found.filter(([, amount]) => amount >= WORTH));
  }
}

export const newest = (list) => (list.length ? list[list.length - 1] : null);

const WAITS = { cpu: "a CPU", memory: "memory", io: "a disk", irq: "interrupt handlers" };

/** "waited for a disk 12 % of the time, for memory 8 %", or nothing: only what is worth a look. */
export function waitWords(waits) {
  const sorted = Object.entries(waits).sort((a, b) => b[1] - a[1]);
  const words = sorted.map(([resource, share], at) =>
    `for ${WAITS[resource] ?? resource} ${share.toFixed(0)}\u00a0%${at ? "" : " of the time"}`);
  return words.length ? `waited ${words.join(", ")}` : "";
}
