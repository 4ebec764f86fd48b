// The nodes of a dataflow, one line each.

import { el, say } from "./dom.js";
import { waitWords } from "./history.js";
import { cpuChart, memoryChart, showState, showUse } from "./parts.js";
import { plural, since, stateOf, uptime } from "./words.js";

const ALIVE = ["ready", "running", "dynamic"];

/** How long ago the node has sent WATCHDOG=1, and how long it may take. */
function signWords({ watchdog_us: limit, watchdog_age_us: age }) {
  if (!limit) return "";
  const seconds = (us) => (us / 1e6).toFixed(1);
  return `watchdog ${age === null ? "-" : seconds(age)} of ${seconds(limit)} s`;
}

/** How long the node has to stop. */
function stopWords({ stop_left_us: left }) {
  return typeof left === "number" ? `${Math.round(left / 1e6)} s left to stop` : "";
}

/** How often dora has restarted the node, and how often it may. */
const restartWords = ({ restarts, max_restarts: most }) =>
  `${plural(restarts, "restart")}${most ? ` of ${most}` : ""}`;

export class NodeRow {
  /** ask: is called with an action and the node. choose: with the node whose logs are wanted. */
  constructor(name, ask, choose) {
    this.badge = el("span", { class: "badge" });
    this.exit = el("span", { class: "exit" });
    this.said = el("span", { class: "said muted" });
    this.machine = el("span", { class: "machine" });
    this.sign = el("span", { class: "sign" });
    this.rights = el("span", { class: "rights" });
    this.up = el("span", { class: "up" });
    this.pid = el("span", { class: "pid" });
    this.restarts = el("span", { class: "restarts" });
    this.charts = { cpu: cpuChart("small"), memory: memoryChart("small") };
    this.waits = el("span", { class: "waits" });
    const act = (action, text) => el("button", { type: "button", class: "small",
      "aria-label": `${text} ${name}`, onclick: () => ask(action, name) }, text);
    this.buttons = { restart: act("restart", "Restart"), stop: act("stop", "Stop") };
    this.limits = act("set", "Limits");
    this.choose = el("button", { type: "button", class: "plain name", "aria-pressed": "false",
      title: `Show the logs of ${name}`, onclick: () => choose(name) }, name);
    this.node = el("li", { "data-node": name },
      el("div", { class: "what" }, this.choose, this.badge, this.exit, this.said),
      el("div", { class: "facts muted" }, this.machine, this.up, this.pid, this.restarts, this.rights,
        this.sign, this.waits),
      this.charts.cpu.node, this.charts.memory.node,
      el("div", { class: "buttons" }, this.buttons.restart, this.buttons.stop, this.limits));
  }

  /** isFree: whether its dataflow is up and nobody acts on it. */
  show(facts, history, isChosen, isFree) {
    const { state, exit, restarts, silent, since_us: at } = facts;
    const isAlive = ALIVE.includes(state);
    showState(this.badge, stateOf(facts));
    say(this.exit, silent ?? (isAlive ? "" : exit));
    say(this.said, isAlive ? facts.text : "");
    say(this.machine, facts.machine ? `on ${facts.machine}` : "");
    const rights = [facts.essential ? "essential" : "", facts.scheduling];
    say(this.rights, rights.filter(Boolean).join(" "));
    say(this.sign, stopWords(facts) || (isAlive ? signWords(facts) : ""));
    const ended = at ? since(at) : "";
    say(this.up, isAlive ? `up ${uptime(at ? Date.now() * 1000 - at : null)}` : ended);
    say(this.pid, isAlive && facts.pid ? `PID ${facts.pid}` : "");
    say(this.restarts, restarts ? restartWords(facts) : "");
    say(this.waits, waitWords(history.waits));
    showUse(this.charts, history, facts);
    this.choose.setAttribute("aria-pressed", String(isChosen));
    for (const button of Object.values(this.buttons)) button.disabled = !isFree || !isAlive;
    this.limits.disabled = !isFree;
  }
}
