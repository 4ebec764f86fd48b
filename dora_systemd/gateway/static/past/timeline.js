// What happened to a dataflow, on one axis: lives, restarts, failures, releases and bundles from the
// journal; what it uses, as long as the page is open, and before that the most and the average of each
// life.

import { el, say, svg } from "../dom.js";
import { SLOW_US } from "../history.js";
import { bytes, clock, percent, plural, since, titled, tone, zoneWords } from "../words.js";
import { HOUR, KINDS, clustered, livesOn, makeAxis, pathOf, ticks } from "./marks.js";

const RANGES = [[0.25, "15 minutes"], [1, "hour"], [6, "6 hours"], [24, "day"], [168, "week"]];
const USUAL = 6;
const MOST_USUAL = 24;
const LANES = { restarts: "Restarts", failures: "Failures", releases: "Releases and bundles" };
const [LABEL, ROW, CHART, AXIS, SIZE] = [18, 26, 40, 20, 26];
const LETTER = 6.4;
const MOST_LISTED = 20;
const MOST_NAMED = 3;
const LEAST = { cpu: 10, memory: 1 << 20 };
// Of each lane: its name, how a value is written, and the fields of a life with its most and average.
const USE = {
  cpu: ["CPU", percent, "cpu_peak_percent", "cpu_average_percent"],
  memory: ["Memory", bytes, "memory_peak_bytes", ""],
};
const EVERY_US = 60e6;
const PAUSE_US = 5e6;
// Of the time between two requests the gateway is busy for at most so much.
const SHARE = 0.02;

const now = () => Date.now() * 1000;

export class Timeline {
  /** ask: requests the timeline of the gateway. showLog: is called with a time in µs. */
  constructor(ask, showLog) {
    Object.assign(this, { ask, showLog, data: null, version: 0, points: [], askedAt: 0, isDue: true,
      pause: PAUSE_US });
    this.range = el("select", { id: "past-range", onchange: () => this.#draw() },
      ...RANGES.map(([hours, text]) => el("option", { value: hours, selected: hours === USUAL }, text)));
    this.note = el("p", { class: "muted note", hidden: true });
    this.picture = el("div", { class: "axis", onkeydown: (event) => this.#move(event),
      onclick: (event) => this.#click(event) });
    this.legend = el("p", { class: "muted legend" });
    this.list = el("ul", { class: "chosen", "aria-label": "Chosen in the timeline", hidden: true });
    this.node = el("section", { class: "panel past", "aria-label": "Timeline" },
      el("div", { class: "head" }, el("h2", {}, "Timeline"),
        el("label", { for: "past-range" }, "of the last ", this.range)),
      this.note, el("div", { class: "around" }, this.picture), this.legend, this.list);
    new ResizeObserver(() => this.#draw()).observe(this.picture);
  }

  /** A message of that type. */
  take(data) {
    this.pause = Math.max(PAUSE_US, (now() - this.askedAt) / SHARE);
    if (data.lives && !this.data) this.range.value = rangeFor(data);
    this.data = data.lives ? data : this.data;
    this.version += 1;
    say(this.note, data.problem || (data.is_cut ? "There was more than is shown here." : ""));
    this.note.hidden = !this.note.textContent;
    this.#draw();
  }

  /** points: what the whole dataflow has used, oldest first. */
  show(flow, points) {
    Object.assign(this, { flow, points });
    const age = now() - this.askedAt;
    if (age > EVERY_US || (this.isDue && age > this.pause)) {
      Object.assign(this, { askedAt: now(), isDue: false });
      this.ask();
    }
    this.#draw();
  }

  #draw() {
    const width = this.picture.clientWidth;
    if (!this.flow || !width) return;
    const wide = this.range.value * HOUR;
    // The axis moves on in steps, so that what somebody points at stays there for a moment.
    const step = Math.max(wide / 400, 5e6);
    const end = Math.ceil(now() / step) * step;
    const key = [width, wide, end, this.version, this.flow.status].join(" ");
    if (key === this.key) return;
    this.key = key;
    const held = document.activeElement?.closest?.(".past [data-key]")?.dataset.key;
    this.axis = makeAxis(end - wide, end, width);
    this.#picture();
    this.#focusable(held);
  }

  #picture() {
    const lives = livesOn(this.data?.lives ?? [], this.axis);
    const groups = clustered(this.data?.marks ?? [], this.axis, SIZE);
    const parts = [];
    let top = this.#lives(parts, lives, 0);
    for (const [lane, name] of Object.entries(LANES)) {
      parts.push(laneName(name, top));
      for (const one of groups.filter((group) => group.lane === lane)) {
        parts.push(this.#mark(one, top + LABEL + ROW / 2));
      }
      top += LABEL + ROW;
    }
    for (const key of Object.keys(USE)) {
      this.#use(parts, key, lives, top);
      top += LABEL + CHART;
    }
    this.#ticks(parts, top);
    const words = `${plural(lives.length, "life").replace("lifes", "lives")}, ${groups
      .reduce((sum, one) => sum + one.marks.length, 0)} events`;
    this.picture.replaceChildren(svg("svg", { width: this.axis.width, height: top + AXIS,
      role: "group", "aria-label": `Timeline: ${words}` }, ...parts));
    this.#legend(groups);
  }

  #lives(parts, lives, top) {
    parts.push(laneName("Lives", top));
    for (const one of lives) {
      const status = one.status || this.flow.status;
      const until = one.ended_us ? `until ${clock(one.ended_us)}` : "until now";
      const text = `${titled(status)}, from ${clock(one.began_us)} ${until}${one.text && `: ${one.text}`}${useWords(one)}`;
      const at = one.ended_us ?? one.began_us;
      parts.push(this.#button(`life ${one.began_us}`, text, tone(status), at,
        [{ at_us: at, text }], svg("rect", { class: "life", x: one.from, y: top + LABEL + 5,
          width: one.to - one.from, height: ROW - 12, rx: 3 })));
    }
    return top + LABEL + ROW;
  }

  #mark(group, y) {
    const { x, letter, count, tone: looks, marks } = group;
    const text = `${letter}${count}`;
    const half = Math.max(10, (text.length * LETTER) / 2 + 5);
    const words = marks.length === 1 ? `${marks[0].text}, ${clock(marks[0].at_us)}`
      : `${marks.length} events from ${clock(marks[0].at_us)}: ${named(marks)}`;
    return this.#button(group.key, words, looks, marks[0].at_us, marks,
      svg("rect", { class: "mark", x: x - half, y: y - 10, width: 2 * half, height: 20, rx: 10 }),
      svg("text", { x, y: y + 4, "text-anchor": "middle" }, text));
  }

  #button(key, label, looks, at, marks, ...shapes) {
    const choose = () => this.#choose(marks);
    return svg("g", { role: "button", class: "thing", tabindex: -1, "aria-label": label,
      "data-key": key, "data-at": at, "data-tone": looks,
      onclick: (event) => {
        event.stopPropagation();
        choose();
      },
      onkeydown: (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        choose();
      } }, svg("title", {}, label), ...shapes);
  }

  /** What was used since the page was opened, and before that by each life. */
  #use(parts, key, lives, top) {
    const [name, format, ...fields] = USE[key];
    const own = this.points.map((one) => ({ at: one.at, value: one[key] }));
    const shown = own.filter(({ at }) => at >= this.axis.begin).map(({ value }) => value);
    const before = own.length ? this.axis.x(own[0].at) : this.axis.width;
    const until = (one) => (one.ended_us ? one.to : Math.max(Math.min(one.to, before), one.from));
    const past = fields.map((field) => lives.filter((one) => one[field] != null)
      .map((one) => ({ from: one.from, to: until(one), value: one[field] })));
    const most = Math.max(LEAST[key], ...shown, ...past.flat().map(({ value }) => value));
    const bottom = top + LABEL + CHART - 4;
    const y = (value) => bottom - (CHART - 6) * (value / most);
    const known = shown.length || past.flat().length ? `, up to ${format(most)}` : "";
    const levels = (found) => found.map((one) => `M${one.from} ${y(one.value)}H${one.to}`).join("");
    parts.push(laneName(`${name}${known}`, top),
      svg("path", { class: `line ${key}`, d: pathOf(own, this.axis, y, 3 * SLOW_US) }),
      svg("path", { class: `peak ${key}`, d: levels(past[0]) }),
      svg("path", { class: `mean ${key}`, d: levels(past[1]) }),
      svg("path", { class: "base", d: `M0 ${bottom}H${this.axis.width}` }));
  }

  #ticks(parts, top) {
    const { step, places } = ticks(this.axis);
    for (const at of places) {
      const x = this.axis.x(at);
      parts.push(svg("path", { class: "tick", d: `M${x} 0V${top}` }));
      const isEdge = x < 20 || x > this.axis.width - 20;
      if (!isEdge) parts.push(svg("text", { class: "when", x, y: top + 15, "text-anchor": "middle" }, tickWords(at, step)));
    }
  }

  #legend(groups) {
    const kinds = new Set(groups.flatMap(({ marks }) => marks.map(({ kind }) => kind)));
    const words = Object.keys(KINDS).filter((kind) => kinds.has(kind))
      .map((kind) => `${KINDS[kind][0]} ${KINDS[kind][1]}`);
    const has = (...fields) => this.data?.lives?.some((one) => fields.some((field) => one[field] != null));
    if (has("cpu_peak_percent", "memory_peak_bytes")) words.push("dashed line: the most of a life");
    if (has("cpu_average_percent")) words.push("dotted line: the average of a life");
    say(this.legend, [...words, zoneWords()].join(" · "));
  }

  /** One of the things can be reached by Tab, the others from there by arrow keys. */
  #focusable(held) {
    const things = this.#things();
    const found = things.find((one) => one.dataset.key === held) ?? things.at(-1);
    found?.setAttribute("tabindex", "0");
    if (held) found?.focus({ preventScroll: true });
  }

  #things() {
    const found = [...this.picture.querySelectorAll(".thing")];
    return found.sort((a, b) => a.dataset.at - b.dataset.at);
  }

  #move(event) {
    const things = this.#things();
    const at = things.indexOf(document.activeElement);
    const steps = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: things.length - 1 };
    const next = things[steps[event.key]];
    if (at < 0 || !next) return;
    event.preventDefault();
    things[at].setAttribute("tabindex", "-1");
    next.setAttribute("tabindex", "0");
    next.focus();
  }

  #click(event) {
    const { left } = this.picture.getBoundingClientRect();
    const at = this.axis?.at(event.clientX - left);
    if (at) this.#choose([{ at_us: Math.min(at, now()), text: "" }]);
  }

  /** Lists what was chosen; of a single one it shows the log, too. */
  #choose(marks) {
    const listed = marks.slice(0, MOST_LISTED);
    const more = marks.length - listed.length;
    const row = ({ at_us: at, text }) => el("li", {},
      el("button", { type: "button", class: "small", "aria-label": `Log at ${clock(at)}`,
        onclick: () => this.showLog(at) }, "Log"),
      el("time", {}, since(at)), el("span", {}, text));
    this.list.replaceChildren(...listed.map(row), more > 0 ? el("li", {}, `and ${more} more`) : "");
    this.list.hidden = !marks.some(({ text }) => text);
    if (marks.length === 1) this.showLog(marks[0].at_us);
  }
}

/** The shortest range with all that has happened, at most a day. */
function rangeFor({ lives, marks }) {
  const first = Math.min(now(), ...[...lives.map((one) => one.began_us), ...marks.map((one) => one.at_us)]);
  const [hours] = RANGES.find(([one]) => now() - one * HOUR < first) ?? [MOST_USUAL];
  return Math.min(hours, MOST_USUAL);
}

/** " (CPU 12 % on average, at most 40 %; memory at most 3 MiB)", as far as that is known. */
function useWords({ cpu_average_percent: mean, cpu_peak_percent: peak, memory_peak_bytes: memory }) {
  const cpu = [mean == null ? "" : `${percent(mean)} on average`, peak == null ? "" : `at most ${percent(peak)}`];
  const parts = [cpu.some(Boolean) ? `CPU ${cpu.filter(Boolean).join(", ")}` : "",
    memory == null ? "" : `memory at most ${bytes(memory)}`].filter(Boolean);
  return parts.length ? ` (${parts.join("; ")})` : "";
}

/** The first texts of several marks. */
const named = (marks) => marks.slice(0, MOST_NAMED).map(({ text }) => text).join("; ")
  + (marks.length > MOST_NAMED ? "; ..." : "");

const laneName = (name, top) => svg("text", { class: "lane", x: 0, y: top + 12 }, name);

/** A time on the axis: of a day if the ticks are days. */
function tickWords(at, step) {
  const date = new Date(at / 1000);
  const isDay = step >= 24 * HOUR || (step >= 6 * HOUR && date.getHours() === 0);
  return isDay ? date.toLocaleDateString([], { day: "numeric", month: "short" }) : clock(at).slice(0, 5);
}
