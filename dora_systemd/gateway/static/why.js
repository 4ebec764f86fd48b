// Why a dataflow failed, since when, and what to do: what `doractl why` says.

import { el } from "./dom.js";
import { Facts, showState } from "./parts.js";
import { bytes, clock, isUp, since, span, tone } from "./words.js";

const TITLES = {
  Failed: "Why it failed", Degraded: "Why it is degraded", Restarting: "Why it restarts",
  Stopped: "How it ended", Finished: "How it ended",
};
const COMMAND = /((?:doractl|systemctl|journalctl|coredumpctl) [^;,]+)/;
const SIZES = { peak: "memory_peak_bytes", limit: "memory_limit_bytes", held: "memory_bytes" };

/** "detector 3 (exit code 1), dataflow 1 (the dora daemon is gone)". */
function restartWords(restarts) {
  const groups = new Map();
  for (const { node, reason } of restarts) {
    const key = JSON.stringify([node || "dataflow", reason]);
    groups.set(key, (groups.get(key) ?? 0) + 1);
  }
  return [...groups].map(([key, count]) => {
    const [who, reason] = JSON.parse(key);
    return `${who} ${count} (${reason})`;
  }).join(", ");
}

function memoryWords(details) {
  const known = Object.entries(SIZES).filter(([, key]) => details[key]);
  return known.map(([name, key]) => `${name} ${bytes(details[key])}`).join(", ");
}

function budgetWords(budget) {
  if (!budget?.used) return "";
  const next = budget.next_us == null ? "" : `, the next one in ${span(budget.next_us)}`;
  return `${budget.used} of ${budget.max} restarts of the dataflow used${next}`;
}

const list = (title, className, items) => (items.length
  ? el("section", { class: className }, el("h3", {}, title),
    el("ul", { tabindex: className === "remedies" ? null : 0, "aria-label": title }, ...items)) : null);

const remedy = (text) => el("li", {}, ...text.split(COMMAND).map((part, at) =>
  (at % 2 ? el("code", {}, part) : part)));

// What a remedy can be done with here, by the command that it names.
const DONE_BY = { start: ["start", "Start"], restart: ["restart", "Restart"], stop: ["stop", "Stop"],
  reload: ["reload", "Reload"], rollback: ["rollback", "Roll back"] };

/** The actions that the remedies for a dataflow name, the first one first. */
function actionsOf({ remedies, name }, isUp) {
  const commands = remedies.flatMap((text) => [...text.matchAll(/doractl (\w+) ([^\s;,]+)([^;,]*)/g)]);
  const own = commands.filter(([, verb, who, rest]) => DONE_BY[verb] && !rest.includes("--node ")
    && (who === name || rest.includes(`--name ${name}`)));
  const found = own.map(([, verb]) => (verb === "restart" && !isUp ? "start" : verb));
  return [...new Set(found)];
}

const line = (at, ...parts) => el("li", {}, el("time", {}, clock(at)), " ", ...parts);

export class Why {
  /** choose: is called with the node whose logs are wanted. ask: with an action. */
  constructor(choose, ask) {
    Object.assign(this, { choose, ask });
    this.node = el("section", { class: "panel why", "aria-label": "Why", hidden: true });
  }

  /** about: the message of that type. */
  show({ why, row, problem }) {
    const status = why?.status ?? row?.status;
    const key = JSON.stringify([why, problem, status]);
    if (key === this.key) return;
    Object.assign(this, { key, at: null });
    const told = why?.summary && TITLES[status] ? this.#told(why, status) : [];
    if (problem && TITLES[status]) told.push(el("p", { class: "muted" }, problem));
    this.node.hidden = !told.length;
    this.node.className = `panel why ${tone(status ?? "")}`;
    const head = el("div", { class: "head" }, el("h2", {}, TITLES[status] ?? ""));
    this.node.replaceChildren(head, ...told);
    // The end of a backtrace says most.
    for (const one of this.node.querySelectorAll("ul")) one.scrollTop = one.scrollHeight;
  }

  /** The time goes on, the text stays: somebody may be selecting it. isFree: whether nobody acts. */
  tick(isFree) {
    for (const one of this.node.querySelectorAll("[data-action]")) one.disabled = !isFree;
    if (this.at) this.facts.show("Since", since(this.at));
  }

  #told(why, status) {
    const badge = el("span", { class: "badge" });
    showState(badge, status);
    const last = why.last_lines.map((one) =>
      line(one.at_us, why.node ? "" : el("b", {}, `${one.node}: `), el("span", {}, one.text)));
    const news = why.timeline.map((one) => line(one.at_us, el("span", {}, one.text || one.event)));
    return [
      el("p", { class: "summary" }, badge, " ", el("strong", {}, why.summary)),
      this.#facts(why),
      list("Where it crashed", "stack", (why.stack ?? []).map((one) =>
        el("li", {}, `${one.function} (${one.place})`))),
      list("What to do", "remedies", why.remedies.map(remedy)),
      this.#buttons(why, status),
      list(`The last ${last.length === 1 ? "line" : `${last.length} lines`} of ${why.node || "its nodes"}`, "words", last),
      why.node ? el("p", {}, el("button", { type: "button", class: "small",
        onclick: () => this.choose(why.node) }, `All logs of ${why.node}`)) : null,
      list("What happened", "timeline", news),
    ].filter(Boolean);
  }

  #buttons(why, status) {
    const actions = actionsOf(why, isUp({ status }));
    const buttons = actions.map((action, at) => el("button", { type: "button", "data-action": action,
      class: at ? null : "strong", onclick: () => this.ask(action, "") }, DONE_BY[action][1]));
    return buttons.length ? el("p", { class: "buttons" }, ...buttons) : null;
  }

  #facts(why) {
    const facts = new Facts();
    Object.assign(this, { facts, at: why.at_us });
    const lasted = why.started_us && why.at_us ? why.at_us - why.started_us : -1;
    facts.show("Since", why.at_us ? since(why.at_us) : "");
    facts.show("After its start", lasted >= 0 ? span(lasted) : "");
    facts.show("Node", why.node ?? "");
    facts.show("Memory", memoryWords(why.details));
    facts.show("Without input", why.starved.join(", "));
    facts.show("Restarts before", restartWords(why.restart_history));
    facts.show("Budget", budgetWords(why.restart_budget));
    facts.show("Before that", why.before ? why.before.summary : "");
    return facts.node;
  }
}
