// The drawing of a dataflow: nodes that can be chosen, and the messages between them as arrows.

import { el, say, svg } from "./dom.js";
import { bundled, layOut } from "./layers.js";
import { plural, sourceName, stateOf, tone } from "./words.js";

const HEIGHT = 46;
const SOURCE_HEIGHT = 28;
const LINE = 16;
const LETTER = 7.6;
const SMALL_LETTER = 6.2;
const LONGEST = 22;
const MARGIN = 12;

const cut = (text, most) => (text.length > most ? `${text.slice(0, most - 1)}…` : text);

/** A name in lines that fit into a box, broken where its words end. */
function folded(text) {
  const lines = [];
  let rest = text;
  while (rest.length > LONGEST) {
    const [head] = rest.match(/^.{1,21}[-_./]|^.{1,22}/u);
    lines.push(head);
    rest = rest.slice(head.length);
  }
  return [...lines, rest];
}

export class Graph {
  /** choose: is called with the id of a node that was chosen. */
  constructor(choose) {
    this.choose = choose;
    this.boxes = new Map();
    this.node = el("div", { class: "graph" });
    this.data = null;
    new ResizeObserver(() => this.#draw()).observe(this.node);
  }

  /** data: a message of the type graph, or null while there is none. */
  show(data) {
    // What is the same keeps its boxes: a click in the middle of another drawing would be lost.
    if (this.data && JSON.stringify(data) === JSON.stringify(this.data)) return;
    this.data = data;
    this.shape = "";
    this.#draw();
  }

  /** Whether there is nothing to draw. */
  get isEmpty() {
    return !this.data?.nodes?.length;
  }

  /** nodes: those of a row; chosen: an id, or "". rest: the state of all others. */
  mark(nodes, chosen, rest = "unknown") {
    this.marks = { nodes, chosen, rest };
    const states = new Map(nodes.map((node) => [node.node, stateOf(node)]));
    for (const [id, box] of this.boxes) {
      const state = states.get(id) ?? rest;
      box.group.setAttribute("data-tone", tone(state));
      box.group.setAttribute("aria-pressed", String(id === chosen));
      box.group.setAttribute("aria-label", `${id}, ${state}: show its logs`);
      say(box.state, state);
    }
  }

  #draw() {
    const wide = this.node.clientWidth;
    if (!this.data || !wide) return void (this.data ?? this.node.replaceChildren());
    const { nodes = [], edges = [], problem } = this.data;
    if (!nodes.length) {
      this.node.replaceChildren(el("p", { class: "muted" }, problem || "No nodes."));
      return;
    }
    const bundles = bundled(edges);
    let isDown = false;
    let plan = this.#plan(nodes, bundles, isDown);
    // Rather down than smaller than can be read.
    if (plan.width * 0.72 > wide) {
      isDown = true;
      plan = this.#plan(nodes, bundles, isDown);
    }
    const shape = `${isDown} ${Math.min(wide, plan.width)}`;
    if (shape === this.shape) return;
    this.shape = shape;
    this.boxes.clear();
    this.node.replaceChildren(this.#picture(nodes, bundles, plan, isDown));
    if (this.marks) this.mark(this.marks.nodes, this.marks.chosen, this.marks.rest);
  }

  #plan(nodes, bundles, isDown) {
    const sized = nodes.map((node) => {
      const isSource = node.kind === "dora";
      const texts = isSource ? [cut(sourceName(node.id), LONGEST)] : folded(node.id);
      const widest = Math.max(...texts.map((one) => one.length));
      const width = Math.max(widest * LETTER + (isSource ? 24 : 40), isSource ? 60 : 112);
      const height = isSource ? SOURCE_HEIGHT : HEIGHT + (texts.length - 1) * LINE;
      return { id: node.id, texts, width, height,
        length: isDown ? height : width, breadth: (isDown ? width : height) + 20 };
    });
    const longest = Math.max(0, ...bundles.map((one) => label(one).length));
    const plan = layOut(sized, bundles, isDown ? 44 : Math.max(56, longest * SMALL_LETTER + 30));
    const [width, height] = isDown ? [plan.breadth, plan.length] : [plan.length, plan.breadth];
    return { ...plan, width: width + 2 * MARGIN, height: height + 2 * MARGIN };
  }

  #picture(nodes, bundles, plan, isDown) {
    const at = ({ along, across }) =>
      (isDown ? [across + MARGIN, along + MARGIN] : [along + MARGIN, across + MARGIN]);
    const arrows = [];
    const labels = [];
    for (const [edge, way] of plan.ways) {
      const isBack = plan.back.has(edge);
      const isBent = isBack && way.length === 2;
      const points = isBent ? bent(way, at, isDown) : led(way, at, isDown);
      const d = isBent ? arc(points) : curve(points, isDown);
      arrows.push(svg("path", { d, class: isBack ? "edge back" : "edge",
        "marker-end": "url(#arrow)" }, svg("title", {}, title(edge))));
      labels.push(edgeLabel(edge, points));
      for (const [x, y] of points) {
        plan.width = Math.max(plan.width, x + MARGIN);
        plan.height = Math.max(plan.height, y + MARGIN);
      }
    }
    for (const edge of plan.loops) {
      const box = plan.places.get(edge.from);
      const [x, y] = at(box);
      const top = y + box.height / 2;
      arrows.push(svg("path", { class: "edge back", "marker-end": "url(#arrow)",
        d: `M${x + 14} ${top}c0 26 -28 26 -28 2` }, svg("title", {}, title(edge))));
    }
    const boxes = nodes.map((node) => this.#box(node, plan.places.get(node.id), at));
    const text = `${plural(nodes.filter((one) => one.kind !== "dora").length, "node")}, ` +
      plural(bundles.length, "connection");
    const picture = svg("svg", {
      viewBox: `0 0 ${plan.width} ${plan.height}`, width: plan.width, height: plan.height,
      role: "group", "aria-label": `The dataflow: ${text}`,
    }, marker(), ...arrows, ...labels, ...boxes);
    picture.style.minWidth = `${Math.round(plan.width * 0.7)}px`;
    return picture;
  }

  #box(node, place, at) {
    const { width, height, texts } = place;
    const [x, y] = at(place);
    const shape = { x: x - width / 2, y: y - height / 2, width, height };
    if (node.kind === "dora") {
      return svg("g", { class: "source" }, svg("title", {}, node.id),
        svg("rect", { ...shape, rx: height / 2 }),
        svg("text", { x, y: y + 4, "text-anchor": "middle" }, texts[0]));
    }
    const left = x - width / 2;
    const first = y - ((texts.length - 1) * LINE) / 2;
    const state = svg("text", { x: left + 26, y: y + height / 2 - 9, class: "state" });
    const group = svg("g", { class: "box", role: "button", tabindex: 0, "data-node": node.id,
      onclick: () => this.choose(node.id),
      onkeydown: (event) => {
        if (event.key !== "Enter" && event.key !== " ") return;
        event.preventDefault();
        this.choose(node.id);
      } },
    svg("title", {}, `${node.id} (${node.kind})`),
    svg("rect", { ...shape, rx: 9 }),
    svg("circle", { cx: left + 14, cy: first - 4, r: 4.5 }),
    ...texts.map((text, at) => svg("text", { x: left + 26, y: first + at * LINE, class: "name" }, text)),
    state);
    this.boxes.set(node.id, { group, state });
    return group;
  }
}

const label = (edge) => cut(edge.names.filter(Boolean).join(", "), LONGEST);
const title = (edge) => `${edge.from} → ${edge.to}: ${edge.names.join(", ")}`;

function marker() {
  const shape = svg("path", { d: "M0 0L8 4L0 8Z" });
  const attributes = { id: "arrow", viewBox: "0 0 8 8", refX: 7, refY: 4, markerWidth: 8,
    markerHeight: 8, markerUnits: "userSpaceOnUse", orient: "auto-start-reverse" };
  return svg("defs", {}, svg("marker", attributes, shape));
}

/** From border to border through the places on the way. */
function led(way, at, isDown) {
  const forward = way[way.length - 1].layer > way[0].layer ? 1 : -1;
  return way.map((place, index) => {
    const [x, y] = at(place);
    const isFirst = index === 0;
    if (!isFirst && index < way.length - 1) return [x, y];
    const side = (isFirst ? 1 : -1) * forward;
    return isDown ? [x, y + (side * place.height) / 2] : [x + (side * place.width) / 2, y];
  });
}

/** Around, for an edge against the flow between neighbours. */
function bent(way, at, isDown) {
  const [from, to] = way.map(at);
  const [first, last] = way;
  if (isDown) {
    const x = Math.max(from[0] + first.width / 2, to[0] + last.width / 2) + 18;
    return [[from[0] + first.width / 2, from[1]], [x, (from[1] + to[1]) / 2],
      [to[0] + last.width / 2, to[1]]];
  }
  const y = Math.max(from[1] + first.height / 2, to[1] + last.height / 2) + 26;
  return [[from[0], from[1] + first.height / 2], [(from[0] + to[0]) / 2, y],
    [to[0], to[1] + last.height / 2]];
}

/** One bow through the middle of three points. */
function arc([[x0, y0], [x1, y1], [x2, y2]]) {
  return `M${x0} ${y0}Q${2 * x1 - (x0 + x2) / 2} ${2 * y1 - (y0 + y2) / 2} ${x2} ${y2}`;
}

function curve(points, isDown) {
  let path = `M${points[0].join(" ")}`;
  for (let at = 1; at < points.length; at += 1) {
    const [[x0, y0], [x1, y1]] = [points[at - 1], points[at]];
    const middle = isDown ? (y0 + y1) / 2 : (x0 + x1) / 2;
    const bend = isDown ? `${x0} ${middle} ${x1} ${middle}` : `${middle} ${y0} ${middle} ${y1}`;
    path += `C${bend} ${x1} ${y1}`;
  }
  return path;
}

function edgeLabel(edge, points) {
  const half = (points.length - 1) / 2;
  const [[x0, y0], [x1, y1]] = [points[Math.floor(half)], points[Math.ceil(half)]];
  const place = { x: (x0 + x1) / 2, y: (y0 + y1) / 2 - 5, class: "label", "text-anchor": "middle" };
  return svg("text", place, label(edge));
}
