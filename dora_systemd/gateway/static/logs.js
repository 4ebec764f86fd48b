// What nodes write, line by line. The page keeps the newest ones only.

import { el, say } from "./dom.js";
import { clock, plural } from "./words.js";

export const MOST = 1000;
const COLORS = 8;
const NEAR = 24;

const LEVELS = [[7, "All"], [6, "Info and above"], [4, "Warnings and errors"], [3, "Errors"]];

function colorOf(node) {
  let sum = 0;
  for (const char of node) sum = (sum * 31 + char.codePointAt(0)) % 997;
  return sum % COLORS;
}

const kind = (line) => {
  if (line.priority <= 3) return "bad";
  if (line.priority === 4) return "warn";
  return line.event ? "event" : line.priority >= 7 ? "debug" : "";
};

export class Logs {
  /** choose: is called with the id of the node to show, "" for all of them. */
  constructor(choose) {
    this.number = 0;
    this.names = [];
    this.pick = el("select", { id: "log-node", onchange: () => choose(this.pick.value) });
    this.level = el("select", { id: "log-level", onchange: () => this.#filter() },
      ...LEVELS.map(([value, text]) => el("option", { value }, text)));
    this.isFollowing = el("input", { type: "checkbox", id: "log-follow", checked: true,
      onchange: () => this.#scroll() });
    this.lines = el("div", { class: "lines", role: "log", "aria-live": "off", tabindex: 0,
      "aria-label": "Log lines", onscroll: () => this.#scrolled() });
    this.node = el("section", { class: "panel logs", "aria-labelledby": "log-title" },
      el("div", { class: "head" },
        el("h2", { id: "log-title" }, "Logs"),
        el("label", { for: "log-node" }, "of ", this.pick),
        el("label", { for: "log-level" }, "level ", this.level),
        el("label", { for: "log-follow", class: "check" }, this.isFollowing, " follow")),
      this.lines);
  }

  /** Begin anew: the number that lines must have, the nodes there are, and the one to show. */
  begin(number, node) {
    this.number = number;
    this.chosen = node;
    this.lines.replaceChildren(el("p", { class: "muted empty" }, "Nothing so far."));
    this.isFollowing.checked = true;
    this.#choose();
  }

  /** The nodes that can be chosen. */
  offer(names) {
    if (names.join("\n") === this.names.join("\n") && this.pick.options.length) return;
    this.names = names;
    this.pick.replaceChildren(el("option", { value: "" }, "all nodes"),
      ...names.map((name) => el("option", { value: name }, name)));
    this.#choose();
  }

  #choose() {
    this.pick.value = this.chosen ?? "";
  }

  add({ number, lines, skipped }) {
    if (number !== this.number) return;
    this.lines.querySelector(".empty")?.remove();
    const added = lines.map((line) => this.#line(line));
    if (skipped) {
      const text = `${plural(skipped, "line")} skipped here; doractl logs shows all`;
      added.unshift(el("p", { class: "note" }, text));
    }
    this.lines.append(...added);
    while (this.lines.childElementCount > MOST) this.lines.firstElementChild.remove();
    this.#scroll();
  }

  #line(line) {
    return el("p", { class: kind(line), "data-priority": line.priority,
      hidden: line.priority > this.level.value },
    el("time", {}, clock(line.at_us)),
    this.chosen ? null : el("span", { class: `who c${colorOf(line.node)}` }, line.node || "dataflow"),
    el("span", { class: "text" }, line.text));
  }

  #filter() {
    for (const line of this.lines.children) {
      if (line.dataset.priority) line.hidden = Number(line.dataset.priority) > this.level.value;
    }
    this.#scroll();
  }

  #scroll() {
    if (this.isFollowing.checked) this.lines.scrollTop = this.lines.scrollHeight;
  }

  // Who scrolls up wants to read; at the end again, to follow.
  #scrolled() {
    const { scrollTop, scrollHeight, clientHeight } = this.lines;
    this.isFollowing.checked = scrollHeight - clientHeight - scrollTop < NEAR;
  }
}
