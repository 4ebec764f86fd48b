// A small graph of the last minutes: a line with what is below it, its scale, and the limit if there
// is one. The pointer shows the value at its place.

import { el, say, svg } from "./dom.js";
import { clock, span } from "./words.js";

const HEIGHT = 100;
const LEAST_SPAN = 30;

export class Chart {
  /** name: what is measured. format: a value as text. */
  constructor(name, format, className = "") {
    this.name = name;
    this.format = format;
    this.share = null;
    this.area = svg("path", { class: "area" });
    this.line = svg("path", { class: "line" });
    this.limit = svg("path", { class: "limit" });
    this.cursor = svg("path", { class: "cursor" });
    this.picture = svg(
      "svg",
      {
        preserveAspectRatio: "none", role: "img",
        onpointermove: (event) => this.#point(event), onpointerdown: (event) => this.#point(event),
        onpointerleave: () => this.#leave(),
      },
      this.area, this.line, this.limit, this.cursor,
    );
    this.value = el("span", { class: "value" });
    this.of = el("span", { class: "of muted" });
    this.top = el("span", { class: "top" });
    this.begin = el("span");
    this.node = el(
      "div", { class: `chart ${className}` },
      el("span", { class: "name muted" }, name),
      el("span", { class: "amount" }, this.value, this.of),
      this.picture,
      el("span", { class: "axis muted", "aria-hidden": "true" },
        this.top, this.begin, el("span", {}, "now")),
    );
  }

  /** values, times: oldest first. limit: or null. least: what the graph is high at least. */
  show(values, times, limit, least) {
    Object.assign(this, { values, times, ceiling: limit });
    const most = Math.max(least, ...values);
    // A limit far above what is used would leave a flat line: it is not drawn then.
    const isNear = limit != null && limit < 4 * most;
    // The room of the label, which neither line crosses.
    const top = 1.3 * (isNear ? Math.max(most, limit) : most);
    // From a minute on, as long as what is known.
    this.wide = Math.max(values.length, LEAST_SPAN) - 1;
    this.picture.setAttribute("viewBox", `0 0 ${this.wide} ${HEIGHT}`);
    const y = (value) => (HEIGHT * (1 - value / top)).toFixed(1);
    const points = values.map((value, at) => `${this.#x(at)} ${y(value)}`).join("L");
    const isLine = values.length > 1;
    this.line.setAttribute("d", isLine ? `M${points}` : "");
    this.area.setAttribute(
      "d", isLine ? `M${this.#x(0)} ${HEIGHT}L${points}L${this.wide} ${HEIGHT}Z` : "");
    this.limit.setAttribute("d", isNear ? `M0 ${y(limit)}H${this.wide}` : "");
    say(this.top, this.format(top));
    say(this.begin, isLine ? `${span(times.at(-1) - times[0])} ago` : "");
    this.#label(values.length ? Math.max(...values) : null);
    this.#read();
  }

  #x(at) {
    return this.wide + 1 - this.values.length + at;
  }

  #label(most) {
    const now = this.values.at(-1);
    const above = this.ceiling == null ? "" : ` of ${this.format(this.ceiling)}`;
    const known = now == null ? "unknown" : `${this.format(now)}${above}, at most ${this.format(most)}`;
    this.picture.setAttribute("aria-label", `${this.name}: ${known}`);
  }

  #point(event) {
    const { left, width } = this.picture.getBoundingClientRect();
    this.share = (event.clientX - left) / width;
    this.#read();
  }

  #leave() {
    this.share = null;
    this.#read();
  }

  /** The value under the pointer with its time, else the newest one with the limit. */
  #read() {
    if (!this.values) return;
    const at = this.share == null ? -1
      : Math.round(this.share * this.wide) - this.#x(0);
    const isPointed = at >= 0 && at < this.values.length;
    const value = isPointed ? this.values[at] : this.values.at(-1);
    say(this.value, value == null ? "–" : this.format(value));
    const above = this.ceiling == null ? "" : ` of ${this.format(this.ceiling)}`;
    say(this.of, isPointed ? ` at ${clock(this.times[at])}` : above);
    this.cursor.setAttribute("d", isPointed ? `M${this.#x(at)} 0V${HEIGHT}` : "");
  }
}
