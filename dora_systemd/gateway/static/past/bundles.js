// The bundles of a dataflow: the evidence of its failures, to download.

import { arrange, el, say } from "../dom.js";
import { bytes, since } from "../words.js";

/** Where a bundle is downloaded. */
export const address = ({ name, bundle }) =>
  `/bundles/${encodeURIComponent(name)}/${encodeURIComponent(bundle)}`;

class BundleRow {
  constructor(one) {
    this.facts = el("div", { class: "facts muted" });
    this.node = el("li", { "data-bundle": one.bundle },
      el("div", { class: "what" }, el("a", { href: address(one), download: one.bundle }, one.bundle)),
      this.facts);
  }

  show({ at_us: at, event, size_bytes: size, summary, by }) {
    const parts = [at ? since(at) : "", event, bytes(size), summary ?? "", by ? `by ${by}` : ""];
    say(this.facts, parts.filter(Boolean).join(" · "));
  }
}

export class Bundles {
  /** button: writes a bundle. */
  constructor(button) {
    this.rows = new Map();
    this.list = el("ul", { class: "nodes bundles" });
    this.command = el("code");
    this.none = el("p", { class: "none-yet" }, "None yet: ", this.command,
      " writes what is known of a failure to one file.");
    this.note = el("p", { class: "muted none-yet", hidden: true });
    this.node = el("section", { class: "panel", "aria-label": "Bundles" },
      el("div", { class: "head" }, el("h2", {}, "Bundles"), button), this.none, this.note, this.list);
  }

  /** A message of that type. */
  take({ bundles = [], problem }) {
    say(this.note, problem);
    this.note.hidden = !problem;
    this.none.hidden = Boolean(bundles.length || problem);
    const known = new Map(bundles.map((one) => [one.bundle, one]));
    arrange(this.list, this.rows, [...known.keys()], (id) => new BundleRow(known.get(id)));
    for (const [id, one] of known) this.rows.get(id).show(one);
  }

  show(flow) {
    say(this.command, `doractl bundle ${flow.name}`);
  }
}
