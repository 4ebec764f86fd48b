// What nodes write, line by line: as it comes, or what a search has found. The page keeps the newest
// lines only; a file has more.

import { el, say } from "./dom.js";
import { clock, local, plural, since, zoneWords } from "./words.js";

export const MOST = 1000;
const COLORS = 8;
const WIDEST = 22;
const NEAR = 24;
const KEPT_MS = 60000;
// What is shown around a moment, in µs.
const BEFORE = 30e6;
const AFTER = 5e6;

const LEVELS = [[7, "All"], [6, "Info and above"], [4, "Warnings and errors"], [3, "Errors"]];
const RUNS = [["", "all runs"], ["CURRENT", "last run"], ["PREVIOUS", "run before"]];
const TIMES = [["", "any time"], ["10m", "last 10 minutes"], ["1h", "last hour"],
  ["1d", "last day"], ["range", "from ... to ..."]];

// Answers to another dataflow's questions may still be on their way.
let asked = 0;

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

const options = (pairs) => pairs.map(([value, text]) => el("option", { value }, text));
const field = (id, text, input) => el("label", { for: id }, `${text} `, input);
const moment = (input) => (input.value ? `@${Math.floor(Date.parse(input.value) / 1000)}` : "");

export class Logs {
  /** choose: is called with a node, or "" for all. send: takes a message to the gateway. */
  constructor(choose, send) {
    this.send = send;
    this.chosen = "";
    this.names = [];
    this.files = new Map();
    const again = () => this.ask();
    this.pick = el("select", { id: "log-node", onchange: () => choose(this.pick.value) });
    this.level = el("select", { id: "log-level", onchange: () => this.#filter() },
      ...options(LEVELS));
    this.run = el("select", { id: "log-run", onchange: again }, ...options(RUNS));
    this.time = el("select", { id: "log-time", onchange: again }, ...options(TIMES));
    const date = (id) => el("input", { id, type: "datetime-local", step: 1, onchange: again });
    this.from = date("log-from");
    this.to = date("log-to");
    this.range = el("span", { class: "range", hidden: true },
      field("log-from", "from", this.from), field("log-to", "to", this.to));
    this.search = el("input", { id: "log-search", type: "search", maxlength: 200,
      placeholder: "text, then Enter", onchange: again });
    this.isFollowing = el("input", { type: "checkbox", id: "log-follow", checked: true,
      onchange: () => this.#scroll() });
    this.found = el("span", { class: "found muted", role: "status" });
    this.lines = el("div", { class: "lines", role: "log", "aria-live": "off", tabindex: 0,
      "aria-label": "Log lines", onscroll: () => this.#scrolled() });
    this.node = el("section", { class: "panel logs", "aria-labelledby": "log-title" },
      el("div", { class: "head" },
        el("h2", { id: "log-title" }, "Logs"), el("span", { class: "muted zone" }, zoneWords()), this.found,
        field("log-node", "of", this.pick), field("log-level", "level", this.level),
        field("log-run", "run", this.run), field("log-time", "time", this.time), this.range,
        field("log-search", "search", this.search),
        el("label", { for: "log-follow", class: "check" }, this.isFollowing, " follow"),
        el("button", { type: "button", class: "small", id: "log-save",
          onclick: () => this.#save() }, "Download")),
      this.lines);
  }

  /** Sets the node to show, "" for all. name: of the dataflow, for files. */
  begin(node, name = this.name) {
    this.chosen = node;
    this.name = name;
    this.#choose();
    this.ask();
  }

  /** Shows the lines around a time, of all nodes. */
  showAt(us) {
    Object.assign(this.time, { value: "range" });
    this.from.value = local(us - BEFORE);
    this.to.value = local(us + AFTER + 1e6);
    this.run.value = this.search.value = "";
    this.ask(us);
    this.node.scrollIntoView({ block: "start" });
    this.lines.focus({ preventScroll: true });
  }

  /** Asks the gateway: for new lines as they come, or for what the fields ask for. moment: the time
   * to show then. */
  ask(moment = 0) {
    this.moment = moment;
    this.range.hidden = this.time.value !== "range";
    const wanted = this.#wanted();
    this.isSearch = Object.values(wanted).some(Boolean);
    this.number = asked += 1;
    this.send({ type: this.isSearch ? "find" : "follow", ...this.#question(this.number) });
    const empty = this.isSearch ? "Searching ..." : "Nothing so far.";
    this.lines.replaceChildren(el("p", { class: "muted empty" }, empty));
    say(this.found, "");
    this.isFollowing.checked = true;
    this.isFollowing.disabled = this.isSearch;
  }

  #question(number) {
    return { node: this.chosen, number, ...this.#wanted() };
  }

  #wanted() {
    const isRange = this.time.value === "range";
    return { search: this.search.value, run: this.run.value,
      since: isRange ? moment(this.from) : this.time.value, until: isRange ? moment(this.to) : "" };
  }

  /** The nodes that can be chosen. */
  offer(names) {
    if (names.join("\n") === this.names.join("\n") && this.pick.options.length) return;
    this.names = names;
    const longest = Math.max(...names.map((name) => name.length), "dataflow".length);
    this.lines.style.setProperty("--who", `${Math.min(longest, WIDEST) + 1}ch`);
    this.pick.replaceChildren(el("option", { value: "" }, "all nodes"),
      ...names.map((name) => el("option", { value: name }, name)));
    this.#choose();
  }

  #choose() {
    this.pick.value = this.chosen;
  }

  /** A message of the type lines, found or file. */
  take(message) {
    if (message.type === "lines" && message.number === this.number) this.#add(message);
    if (message.type === "found" && message.number === this.number) this.#end(message);
    const file = this.files.get(message.number);
    if (message.type === "file") file?.push(message.text);
    if (message.type === "found" && file) this.#write(file, message);
  }

  #add({ lines, skipped }) {
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

  #end({ count, is_whole: isWhole, problem, hint }) {
    if (!count) {
      const text = problem ? [problem, hint].filter(Boolean).join(" – ") : "No line matches.";
      this.lines.replaceChildren(el("p", { class: "muted empty" }, text));
    }
    const told = isWhole ? plural(count, "line") : `the newest ${plural(count, "line")}`;
    const where = this.moment ? ` around ${since(this.moment)}` : "";
    say(this.found, problem ? "" : `${told} found${where}`);
    if (this.moment) this.#showMoment();
  }

  /** Scrolls to the last line before the moment. */
  #showMoment() {
    const before = [...this.lines.children].filter((one) => Number(one.dataset.at) <= this.moment);
    const line = before.at(-1) ?? this.lines.firstElementChild;
    line.classList.add("moment");
    this.lines.scrollTop = line.offsetTop - this.lines.offsetTop - this.lines.clientHeight / 2;
  }

  #save() {
    const number = asked += 1;
    this.files.set(number, []);
    this.send({ type: "save", ...this.#question(number) });
    say(this.found, "preparing the file ...");
  }

  #write(parts, { number, count, is_whole: isWhole, problem }) {
    this.files.delete(number);
    say(this.found, problem || `file: ${isWhole ? "" : "the newest "}${plural(count, "line")}`);
    if (problem) return;
    const href = URL.createObjectURL(new Blob(parts, { type: "text/plain" }));
    const name = [this.name, this.chosen].filter(Boolean).join("-");
    el("a", { href, download: `${name}.log` }).click();
    setTimeout(() => URL.revokeObjectURL(href), KEPT_MS);
  }

  #line(line) {
    return el("p", { class: kind(line), "data-priority": line.priority, "data-at": line.at_us,
      hidden: line.priority > this.level.value },
    el("time", { title: new Date(line.at_us / 1000).toLocaleString() }, clock(line.at_us)),
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
