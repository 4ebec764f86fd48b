// Where things are on the axis of a timeline: pure, without the page.

export const HOUR = 3600e6;
const MINUTE = 60e6;
const STEPS = [1, 5, 10, 15, 30, 60, 120, 180, 360, 720, 1440].map((one) => one * MINUTE);
const LEAST_TICK = 74;
const GAP = 4;

// By the kind of a mark: its letter, what that means, how it looks, and its lane.
export const KINDS = {
  restart: ["R", "restarted automatically", "warn", "restarts"],
  request: ["A", "asked for", "busy", "restarts"],
  failure: ["F", "failure", "bad", "failures"],
  memory: ["M", "memory", "bad", "failures"],
  silence: ["S", "silence", "warn", "failures"],
  deploy: ["D", "deploy", "good", "releases"],
  rollback: ["B", "rolled back", "warn", "releases"],
  bundle: ["E", "evidence: a bundle", "calm", "releases"],
};
const WORST = ["bad", "warn", "busy", "good", "calm"];

/** The axis from `begin` to `end` in µs, `width` long. */
export function makeAxis(begin, end, width) {
  const x = (at) => ((at - begin) / (end - begin)) * width;
  return { begin, end, width, x, at: (place) => begin + (place / width) * (end - begin) };
}

/** Places of the labels: full hours, minutes or days of the reader. */
export function ticks({ begin, end, width }) {
  const least = (LEAST_TICK / width) * (end - begin);
  const step = STEPS.find((one) => one >= least) ?? STEPS.at(-1);
  const zone = new Date(end / 1000).getTimezoneOffset() * MINUTE;
  const found = [];
  for (let at = Math.ceil((begin - zone) / step) * step + zone; at < end; at += step) found.push(at);
  return { step, places: found };
}

/** Marks that would cover each other become one. size: in pixels. What is one stays one while the
 * axis moves on. */
export function clustered(marks, axis, size) {
  const found = new Map();
  const wide = axis.at(size) - axis.begin;
  for (const mark of marks) {
    if (mark.at_us < axis.begin || mark.at_us > axis.end || !KINDS[mark.kind]) continue;
    const lane = KINDS[mark.kind][3];
    const place = `${lane} ${Math.floor(mark.at_us / wide)}`;
    if (!found.has(place)) found.set(place, { key: `${lane} ${mark.at_us}`, lane, marks: [] });
    found.get(place).marks.push(mark);
  }
  return [...found.values()].map((one) => ({ ...one, ...looks(one.marks), x: middle(one, axis, size) }));
}

function looks(marks) {
  const tones = marks.map(({ kind }) => KINDS[kind][2]);
  const first = KINDS[marks[0].kind][0];
  const isOne = marks.every(({ kind }) => KINDS[kind][0] === first);
  const count = marks.length > 99 ? "99+" : String(marks.length);
  return { tone: WORST.find((one) => tones.includes(one)), letter: isOne ? first : "",
    count: marks.length > 1 ? count : "" };
}

function middle({ marks }, axis, size) {
  const sum = marks.reduce((all, one) => all + axis.x(one.at_us), 0);
  return Math.min(Math.max(sum / marks.length, size / 2), axis.width - size / 2);
}

/** Lives on the axis, each at least a few pixels wide. */
export function livesOn(lives, axis) {
  return lives.filter((one) => (one.ended_us ?? axis.end) >= axis.begin && one.began_us <= axis.end)
    .map((one) => {
      const from = Math.max(axis.x(one.began_us), 0);
      const to = Math.min(axis.x(one.ended_us ?? axis.end), axis.width);
      return { ...one, from: Math.min(from, axis.width - GAP), to: Math.max(to, from + GAP) };
    });
}

/** The points of a line, as the commands of a path; where too much is missing the line ends.
 * y: of a value. gap: µs. */
export function pathOf(points, axis, y, gap) {
  let last = -Infinity;
  return points.filter(({ at }) => at >= axis.begin && at <= axis.end).map(({ at, value }) => {
    const command = at - last > gap ? "M" : "L";
    last = at;
    return `${command}${axis.x(at).toFixed(1)} ${y(value).toFixed(1)}`;
  }).join("");
}
