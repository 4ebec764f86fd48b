// What can be done with a dataflow or a node: buttons, the question before it, and how it went.

import { el, say } from "./dom.js";
import { isUp, leftWords } from "./words.js";

const SAID_MS = 8000;

const by = (id) => document.getElementById(id);

const SET = ["Limits", "They take effect at once, and last until the dataflow is stopped or disabled. "
  + "An empty field means no limit.", "changing"];

// Word on the button, what it does, and the word while it is done.
const ACTIONS = {
  start: ["Start", "All nodes start, with the settings that it had.", "starting"],
  stop: ["Stop", "Its nodes are told to stop; those still running after the grace duration are killed.",
    "stopping"],
  restart: ["Restart", "All nodes stop and start again; name, UUID and settings stay.", "restarting"],
  reload: ["Reload", "Files that have changed take effect; only the affected nodes restart.",
    "reloading"],
  enable: ["Start at boot", "It starts at every boot, as it runs now.", "enabling"],
  disable: ["Not at boot", "It no longer starts at boot; if it runs, it keeps running.", "disabling"],
  rollback: ["Roll back", "The older release starts in place of the present one. If not all of its "
    + "nodes become ready, or one fails, the present one runs again.", "rolling back"],
  bundle: ["Write a bundle of", "What is known of it now goes to one file, with what its nodes have logged. "
    + "The settings and arguments of the nodes, and values of variables, stay out.",
  "writing a bundle of"],
  set: SET,
  "hot-reload": ["Hot reload", "While it is on, nodes restart when their files change.", "changing"],
  "set node": SET,
  "stop node": ["Stop", "It stays down until the dataflow is restarted; the other nodes keep running.",
    "stopping"],
  "restart node": ["Restart", "The other nodes keep running.", "restarting"],
};

const ENDING = ["stop", "restart"];

const LIMITS = {
  memory_limit: ["Memory", "4G"], memory_high: ["Memory, slowed down beyond", "3G"],
  cpu_limit: ["CPU, in cores or percent of one", "1.5"], tasks_limit: ["Processes and threads", "500"],
};

/** The limits of a dataflow, or of one of its nodes, by the same keys. */
function limitsOf(node, facts) {
  if (!node) return facts;
  // In texts such as "camera:memory_limit=2G,cpu_limit=150%", as doractl set --node takes them.
  const text = facts.nodes?.find((one) => one.startsWith(`${node}:`)) ?? "";
  return Object.fromEntries(text.slice(node.length + 1).split(",").map((one) => one.split("=")));
}

/** The new limits as the values of "set". */
function asSettings(node, limits) {
  const pairs = Object.entries(limits).map(([key, text]) => `${key}=${text}`);
  return node && pairs.length ? { nodes: `${node}:${pairs.join(",")}` } : limits;
}

/** The buttons of a dataflow. ask: is called with an action. */
export class Buttons {
  constructor(ask) {
    const button = (action) => el("button", { type: "button", "data-action": action,
      onclick: () => {
        this.menu.open = false;
        ask(action, "");
      } }, ACTIONS[action][0]);
    this.all = Object.fromEntries(Object.keys(ACTIONS).filter((one) => !one.endsWith(" node"))
      .map((action) => [action, button(action)]));
    // That of bundles stands beside these.
    const { start, stop, restart, bundle, ...rest } = this.all;
    say(bundle, "Write a bundle");
    const leave = (event) => {
      if (event.key !== "Escape" || !this.menu.open) return;
      this.menu.open = false;
      this.menu.firstElementChild.focus();
    };
    this.menu = el("details", { class: "menu", onkeydown: leave }, el("summary", {}, "More"),
      el("div", { class: "items" }, ...Object.values(rest)));
    this.pending = el("span", { class: "pending muted", role: "status" });
    this.node = el("div", { class: "buttons" }, this.pending, start, restart, stop, this.menu);
  }

  /** flow: a row, with isEnded if systemd has unloaded it. about: the message of that type. */
  show(flow, about, isFree) {
    const { start, stop, restart, reload, enable, disable, set, rollback } = this.all;
    const up = isUp(flow);
    start.hidden = up;
    restart.hidden = stop.hidden = !up;
    disable.hidden = !about?.row?.enabled;
    enable.hidden = !disable.hidden;
    rollback.hidden = !flow.release;
    this.menu.hidden = Boolean(flow.isEnded);
    for (const button of Object.values(this.all)) button.disabled = !isFree;
    for (const button of [reload, set, this.all["hot-reload"]]) button.disabled = !isFree || !up;
    say(this.all["hot-reload"], `Hot reload ${about?.facts?.hot_reload ? "off" : "on"}`);
  }
}

const limitField = (key, facts) => el("label", { for: key }, LIMITS[key][0],
  el("input", { id: key, value: facts[key] ?? "", placeholder: LIMITS[key][1], maxlength: 40,
    autocomplete: "off", onkeydown: (event) => {
      if (event.key !== "Enter") return;
      // The first button of the form is the one that Enter would press.
      event.preventDefault();
      by("confirmed").click();
    } }));

/** What has been typed into the fields of limits, as far as it is new. */
function limitsGiven(facts) {
  const pairs = Object.keys(LIMITS).map((key) => [key, by(key).value.trim()]);
  return Object.fromEntries(pairs.filter(([key, text]) => text !== (facts[key] ?? ""))
    .map(([key, text]) => [key, text || "infinity"]));
}

/** Asks in a dialog; then calls `act` with the action, the node, the values of "set" and the release.
 * release: of "rollback", "" for the one before the present one. */
export function askFirst(action, node, flow, facts, act, release = "") {
  const [word, consequence] = ACTIONS[node ? `${action} node` : action];
  const isSet = action === "set";
  const hotReload = { hot_reload: facts.hot_reload ? "off" : "on" };
  const title = action === "hot-reload" ? `${word} ${hotReload.hot_reload}` : word;
  const limits = limitsOf(node, facts);
  say(by("question"), isSet ? `Limits of ${node ? `node ${node} of ` : ""}${flow.name}`
    : `${title} ${node ? `node ${node} of ${flow.name}` : flow.name}${release && ` to ${release}`}?`);
  const ended = (flow.nodes ?? []).filter((one) => !node || one.node === node);
  say(by("consequence"), `${consequence}${ENDING.includes(action) ? leftWords(ended) : ""}`);
  say(by("confirmed"), isSet ? "Set" : title);
  by("confirmed").dataset.action = action;
  by("limits").replaceChildren(...(isSet ? Object.keys(LIMITS).map((k) => limitField(k, limits)) : []));
  const dialog = by("confirm");
  dialog.returnValue = "";
  dialog.onclose = () => {
    if (dialog.returnValue !== "yes") return;
    // On a busy machine the event of an earlier "no" can come as late as that of this "yes".
    dialog.returnValue = "";
    const values = isSet ? asSettings(node, limitsGiven(limits)) : hotReload;
    if (action === "hot-reload") act("set", "", values);
    else if (!isSet || Object.keys(values).length) act(action, node, isSet ? values : {}, release);
  };
  dialog.showModal();
  by("limits").querySelector("input")?.focus();
}

/** What is being done, for beside the buttons. */
export const doing = (action, what) => `${ACTIONS[action][2]} ${what} …`;

/** How an action went. */
export function tell({ text, problem, hint }) {
  const note = el("p", { class: problem ? "toast bad" : "toast" },
    problem ? [problem, hint].filter(Boolean).join(" – ") : text);
  by("said").append(note);
  setTimeout(() => note.remove(), SAID_MS);
}
