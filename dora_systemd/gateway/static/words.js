// Numbers and states as people read them; the words are those of doractl list.

const UNITS = ["B", "K", "M", "G", "T"];

export function bytes(size) {
  if (size == null) return "–";
  let unit = 0;
  while (size >= 1024 && unit < UNITS.length - 1) {
    size /= 1024;
    unit += 1;
  }
  const digits = size < 9.95 && unit > 0 ? 1 : 0;
  return `${size.toFixed(digits).replace(/\.0$/, "")}\u00a0${UNITS[unit]}${unit ? "iB" : ""}`;
}

export const percent = (share) => (share == null ? "–" : `${share.toFixed(share < 99.95 ? 1 : 0)}\u00a0%`);

const two = (number) => String(number).padStart(2, "0");

export function uptime(us) {
  if (us == null || us < 0) return "–";
  const seconds = Math.floor(us / 1e6);
  const days = Math.floor(seconds / 86400);
  const clock = [Math.floor(seconds / 3600) % 24, Math.floor(seconds / 60) % 60, seconds % 60];
  return `${days ? `${days}d ` : ""}${clock.map(two).join(":")}`;
}

export function clock(us) {
  const date = new Date(us / 1000);
  return [date.getHours(), date.getMinutes(), date.getSeconds()].map(two).join(":");
}

/** A time for a field of the type datetime-local. */
export function local(us) {
  const date = new Date(us / 1000);
  const day = [date.getFullYear(), two(date.getMonth() + 1), two(date.getDate())].join("-");
  return `${day}T${clock(us)}`;
}

const SPANS = [[86400, "d"], [3600, "h"], [60, "min"], [1, "s"]];

/** A duration in µs by its largest unit, such as "5 min". */
export function span(us) {
  const seconds = Math.max(us / 1e6, 0);
  const [size, unit] = SPANS.find(([one]) => seconds >= one) ?? SPANS.at(-1);
  return `${Math.floor(seconds / size)} ${unit}`;
}

const FORM = {
  day: "numeric", month: "short", year: "numeric", hour: "2-digit", minute: "2-digit",
  second: "2-digit", hourCycle: "h23", timeZoneName: "short",
};

/** Minutes by which the reader is ahead of UTC at that time. */
const ahead = (us) => -new Date(us / 1000).getTimezoneOffset();

/** A time of day in UTC, where the reader has another one. */
function utcWords(us) {
  if (!ahead(us)) return "";
  return ` (${new Date(us / 1000).toISOString().slice(11, 19)} UTC)`;
}

/** A time in the zone of the reader and in UTC, and how long ago that is. */
export function since(us) {
  const at = new Date(us / 1000).toLocaleString([], FORM);
  return `${at}${utcWords(us)}, ${span(Date.now() * 1000 - us)} ago`;
}

/** What times of day on the page are: "times in UTC", "times in UTC+02:00". */
export function zoneWords() {
  const minutes = ahead(Date.now() * 1000);
  const size = Math.abs(minutes);
  const text = `${minutes < 0 ? "−" : "+"}${two(Math.floor(size / 60))}:${two(size % 60)}`;
  return `times in UTC${minutes ? text : ""}`;
}

export const plural = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;

const TONES = {
  running: "good", ready: "good", dynamic: "good", finished: "calm", stopped: "calm",
  starting: "busy", stopping: "busy", restarting: "warn", reloading: "busy", degraded: "warn",
  waiting: "warn", frozen: "warn", failed: "bad", silent: "warn",
  current: "good", trial: "busy", proved: "calm", unproved: "warn",
  "rolled-back": "warn",
};

/** The state of a node; one that runs and sends nothing is silent. */
export const stateOf = (node) => (node.silent ? "silent" : node.state);

/** How a state looks: good, busy, warn, bad or calm. */
export const tone = (state) => TONES[state.toLowerCase()] ?? "calm";

export const titled = (state) => state.charAt(0).toUpperCase() + state.slice(1);

const FIRST = ["Failed", "Degraded", "Restarting", "Frozen"];

/** For sort(): what needs a hand comes first, the rest by name. */
export function byNeed(a, b) {
  const rank = ({ status }) => (FIRST.includes(status) ? FIRST.indexOf(status) : FIRST.length);
  return rank(a) - rank(b) || (a.name < b.name ? -1 : 1);
}

const UP = ["Starting", "Waiting", "Running", "Degraded", "Stopping", "Restarting", "Frozen"];
export const isUp = (dataflow) => UP.includes(dataflow.status);

/** The containers that do not end with the nodes that have started them, each with its node. */
export const outside = (nodes) => nodes.flatMap(({ node, containers }) =>
  (containers ?? []).filter(({ inside }) => !inside).map((one) => ({ ...one, node })));

const SHORT_ID = 12;

/** "podman container arm (0123456789ab, 12 MiB) of policy". */
export function containerWords({ program, id, name, memory_bytes: memory, node }) {
  if (!id) return `a container of ${program} that is not known, of ${node}`;
  const facts = [id.slice(0, SHORT_ID), memory ? bytes(memory) : ""].filter(Boolean).join(", ");
  return `${program} container${name ? ` ${name}` : ""} (${facts}) of ${node}`;
}

/** What a stop of these nodes leaves, and the commands that stop that; "" for nothing. */
export function leftWords(nodes) {
  const left = outside(nodes);
  if (!left.length) return "";
  const commands = left.filter(({ id }) => id).map(({ program, id, name }) =>
    `${program} stop ${name || id.slice(0, SHORT_ID)}`);
  const after = commands.length ? `; afterwards run: ${commands.join("; ")}` : "";
  return ` ${left.map(containerWords).join(", ")} ${left.length === 1 ? "runs" : "run"} on${after}.`;
}

const TIMES = { millis: "ms", secs: "s", micros: "µs", nanos: "ns" };

/** A source of dora's own, such as dora/timer/millis/20, in short. */
export function sourceName(id) {
  const [, kind, unit, amount] = id.split("/");
  if (kind !== "timer" || !amount) return id.replace(/^dora\//, "");
  return unit === "hz" ? `${amount} Hz` : `every ${amount} ${TIMES[unit] ?? unit}`;
}
