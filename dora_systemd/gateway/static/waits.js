// What the processes of a dataflow had to wait for, and which processes used the CPU meanwhile.

import { el, say } from "./dom.js";
import { waitWords } from "./history.js";

// Percent of waiting from which the page requests the processes that use the CPU. `doractl why` has
// the same limit.
const LONG = 20;
const EVERY_MS = 30000;
const MEANING = "This is the share of the last seconds in which a process was ready to continue, but had to wait.";

export class Waits {
  /** ask: requests the processes that use the CPU from the gateway. */
  constructor(ask) {
    this.ask = ask;
    this.askedAt = -EVERY_MS;
    this.words = el("p");
    this.rivals = el("ul");
    this.node = el("section", { class: "waits", "aria-label": "Waiting", hidden: true },
      this.words, this.rivals);
  }

  show(flow, history) {
    const names = ["", ...flow.nodes.map(({ node }) => node)];
    const all = names.map((name) => history.of(flow.uuid, name).waits);
    const isLong = all.some((one) => (one.cpu ?? 0) >= LONG || (one["its CPU limit"] ?? 0) >= LONG);
    const text = waitWords(all[0]);
    say(this.words, text ? `Its processes ${text}. ${MEANING}` : "");
    if (isLong && performance.now() - this.askedAt > EVERY_MS) {
      this.askedAt = performance.now();
      this.ask();
    }
    if (!isLong) this.rivals.replaceChildren();
    this.node.hidden = !text && !this.rivals.childElementCount;
  }

  /** A message of that type. */
  take({ waits = [], remedies = [] }) {
    this.rivals.replaceChildren(...[...waits, ...remedies].map((one) => el("li", {}, one)));
  }
}
