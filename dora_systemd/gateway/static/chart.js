// A small graph of the last minutes: a line with what is below it, and the limit if there is one.

import { el, say, svg } from "./dom.js";

const HEIGHT = 100;
const LEAST_SPAN = 30;

export class Chart {
  /** name: what is measured. format: a value as text. */
  constructor(name, format, className = "") {
    this.name = name;
    this.format = format;
    this.area = svg("path", { class: "area" });
    this.line = svg("path", { class: "line" });
    this.limit = svg("path", { class: "limit" });
    this.picture = svg(
      "svg",
      { preserveAspectRatio: "none", role: "img" },
      this.area, this.line, this.limit,
    );
    this.value = el("span", { class: "value" });
    this.of = el("span", { class: "of muted" });
    this.node = el(
      "div", { class: `chart ${className}` },
      el("span", { class: "name muted" }, name),
      el("span", { class: "amount" }, this.value, this.of),
      this.picture,
    );
  }

  /** values: oldest first. limit: or null. least: what the graph is high at least. */
  show(values, limit, least) {
    const now = values.length ? values[values.length - 1] : null;
    say(this.value, now == null ? "–" : this.format(now));
    say(this.of, limit == null ? "" : ` of ${this.format(limit)}`);
    const most = Math.max(least, ...values);
    // A limit far above what is used would leave a flat line: it is not drawn then.
    const isNear = limit != null && limit < 4 * most;
    const top = 1.1 * (isNear ? Math.max(most, limit) : most);
    // From a minute on, as long as what is known.
    const span = Math.max(values.length, LEAST_SPAN) - 1;
    this.picture.setAttribute("viewBox", `0 0 ${span} ${HEIGHT}`);
    const x = (at) => span + 1 - values.length + at;
    const y = (value) => (HEIGHT * (1 - value / top)).toFixed(1);
    const points = values.map((value, at) => `${x(at)} ${y(value)}`).join("L");
    this.line.setAttribute("d", values.length > 1 ? `M${points}` : "");
    this.area.setAttribute(
      "d",
      values.length > 1 ? `M${x(0)} ${HEIGHT}L${points}L${span} ${HEIGHT}Z` : "",
    );
    this.limit.setAttribute("d", isNear ? `M0 ${y(limit)}H${span}` : "");
    const above = limit == null ? "" : ` of ${this.format(limit)}`;
    const label = `${this.name}: ${now == null ? "unknown" : this.format(now) + above}`;
    this.picture.setAttribute("aria-label", label);
  }
}
