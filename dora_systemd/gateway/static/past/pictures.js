// The last picture of each camera that was recorded, with its time and where it comes from.

import { arrange, el, say } from "../dom.js";
import { isUp, since } from "../words.js";
import { address } from "./bundles.js";

const [OFTEN_MS, SELDOM_MS] = [10e3, 60e3];
// Of the time between two requests the gateway is busy for at most so much, unless it is slow.
const SHARE = 0.02;
const MOST_WIDTH = 800;
const LINE_END = 10;

class Figure {
  constructor(output) {
    this.output = output;
    this.canvas = el("canvas", { role: "img", "aria-label": `Last picture of ${output}` });
    this.problem = el("span");
    this.time = el("span");
    this.origin = el("span");
    this.node = el("li", { "data-output": output }, el("figure", {}, this.canvas,
      el("figcaption", { class: "muted" }, el("strong", {}, output), this.problem, " · ", this.time,
        " · ", this.origin)));
  }

  /** one: what is known of the picture. name: of the dataflow. */
  show(one, name) {
    this.at = one.at_us;
    this.origin.replaceChildren(...(one.bundle
      ? ["from the bundle ", el("a", { href: address({ name, bundle: one.bundle }),
        download: one.bundle }, one.bundle)]
      : ["from the memory of the recorder"]));
    this.tick();
  }

  async draw(blob) {
    const picture = await createImageBitmap(blob).catch(() => null);
    say(this.problem, picture ? "" : " cannot be shown");
    this.canvas.hidden = !picture;
    if (!picture) return;
    const scale = Math.min(MOST_WIDTH / picture.width, 1);
    this.canvas.width = Math.max(Math.round(picture.width * scale), 1);
    this.canvas.height = Math.max(Math.round(picture.height * scale), 1);
    this.canvas.getContext("2d").drawImage(picture, 0, 0, this.canvas.width, this.canvas.height);
    picture.close();
  }

  /** The time goes on. */
  tick() {
    say(this.time, since(this.at));
  }
}

/** What an answer of the gateway has: a line of JSON, and the bytes of each picture. */
function parse(bytes) {
  const end = bytes.indexOf(LINE_END);
  let at = end + 1;
  return JSON.parse(new TextDecoder().decode(bytes.subarray(0, end))).map((one) => {
    const own = bytes.subarray(at, at + one.size_bytes);
    at += one.size_bytes;
    return { ...one, blob: new Blob([own], { type: one.type }) };
  });
}

export class Pictures {
  constructor(uuid) {
    Object.assign(this, { uuid, rows: new Map(), isDue: true, isBusy: false, askedAt: 0, pause: 0 });
    this.list = el("ul");
    this.node = el("section", { class: "panel pictures", "aria-label": "Last pictures", hidden: true },
      el("div", { class: "head" }, el("h2", {}, "Last pictures")), this.list);
  }

  show(flow) {
    for (const row of this.rows.values()) row.tick();
    const age = performance.now() - this.askedAt;
    const every = isUp(flow) && this.rows.size ? OFTEN_MS : SELDOM_MS;
    const isNow = (this.isDue || age > every) && age > this.pause;
    if (isNow && !this.isBusy && !document.hidden) this.#request(flow.name);
  }

  async #request(name) {
    Object.assign(this, { isBusy: true, isDue: false, askedAt: performance.now() });
    try {
      const answer = await fetch(`/pictures/${this.uuid}`);
      if (answer.ok) await this.#take(parse(new Uint8Array(await answer.arrayBuffer())), name);
    } catch {
      // The gateway has gone: what is shown stays.
    }
    this.pause = Math.min((performance.now() - this.askedAt) / SHARE, SELDOM_MS);
    this.isBusy = false;
  }

  async #take(pictures, name) {
    const known = new Map(pictures.map((one) => [one.output, one]));
    arrange(this.list, this.rows, [...known.keys()], (output) => new Figure(output));
    for (const [output, one] of known) this.rows.get(output).show(one, name);
    this.node.hidden = !known.size;
    for (const [output, { blob }] of known) await this.rows.get(output).draw(blob);
  }
}
