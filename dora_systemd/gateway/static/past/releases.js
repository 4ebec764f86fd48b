// The releases of a dataflow, newest first, and the buttons that run another one.

import { arrange, el, say } from "../dom.js";
import { showState } from "../parts.js";
import { bytes, plural, since } from "../words.js";

const TRIAL_LOOKS = 3;

/** What it was made with, as "dora 1.1.0, Python 3.13.5". */
const versionWords = ({ dora, python }) =>
  [dora && `dora ${dora}`, python && `Python ${python}`].filter(Boolean).join(", ");

/** The directory of a dataflow's file, quoted for a shell if it has to be. */
function directory(file) {
  const path = file?.replace(/\/[^/]*$/, "") || ".";
  return /^[\w./+-]+$/.test(path) ? path : `'${path.replaceAll("'", "'\\''")}'`;
}

class ReleaseRow {
  constructor(id, ask) {
    this.badge = el("span", { class: "badge" });
    this.facts = el("div", { class: "facts muted" });
    this.button = el("button", { type: "button", class: "small", "aria-label": `Roll back to ${id}`,
      onclick: () => ask(id) }, "Roll back");
    this.node = el("li", { "data-release": id },
      el("div", { class: "what" }, el("span", { class: "name" }, id), this.badge), this.facts,
      el("div", { class: "buttons" }, this.button));
  }

  /** hasTrial: whether another one runs on trial, in place of the present one. */
  show(one, hasTrial, isFree) {
    showState(this.badge, one.state);
    const parts = [one.created_us ? since(one.created_us) : "",
      one.size_bytes == null ? "" : `${bytes(one.size_bytes)} in ${plural(one.files, "file")}`,
      versionWords(one.versions ?? {}), one.why ?? ""];
    say(this.facts, parts.filter(Boolean).join(" · "));
    this.button.hidden = one.state === "trial" || (one.state === "current" && !hasTrial);
    this.button.disabled = !isFree;
  }
}

export class Releases {
  /** ask: is called with the id of a release. */
  constructor(ask) {
    this.ask = ask;
    this.rows = new Map();
    this.known = [];
    this.isDue = false;
    this.looks = 0;
    this.list = el("ul", { class: "nodes releases" });
    this.command = el("code");
    this.none = el("p", { class: "none-yet" }, "None yet: it runs from its project directory. ",
      this.command, " copies the project, runs the copy on trial, and can roll back.");
    this.note = el("p", { class: "muted", hidden: true });
    this.node = el("section", { class: "panel", "aria-label": "Releases", hidden: true },
      el("div", { class: "head" }, el("h2", {}, "Releases")), this.none, this.note, this.list);
  }

  get hasTrial() {
    return this.known.some(({ state }) => state === "trial");
  }

  /** Whether it is time to ask for them: after news, and now and then for the end of a trial. */
  isNext() {
    this.looks = this.hasTrial ? this.looks + 1 : 0;
    const isNow = this.isDue || this.looks > TRIAL_LOOKS;
    if (isNow) this.looks = 0;
    this.isDue = false;
    return isNow;
  }

  take({ releases, problem }) {
    this.known = releases ?? this.known;
    say(this.note, problem);
    this.note.hidden = !problem;
    this.#draw();
  }

  /** flow: a row, with the release that it runs, null without any. */
  show(flow, isFree) {
    this.isFree = isFree;
    this.isDeployed = Boolean(flow.release);
    this.node.hidden = Boolean(flow.isEnded || flow.machine);
    this.none.hidden = this.isDeployed;
    say(this.command, `doractl deploy ${directory(flow.file)} --name ${flow.name}`);
    this.#draw();
  }

  #draw() {
    if (!this.isDeployed) this.known = [];
    arrange(this.list, this.rows, this.known.map(({ release }) => release), (id) =>
      new ReleaseRow(id, this.ask));
    for (const one of this.known) {
      this.rows.get(one.release).show(one, this.hasTrial, this.isFree);
    }
  }
}
