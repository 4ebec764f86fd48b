// Where the nodes of a dataflow are drawn: in layers along the flow, so that edges go one way.
//
// Layers by the longest way from a source, order within a layer by the middle of the neighbours,
// and edges that skip layers are led through places of their own (Sugiyama's method, in small).
// `along` is the direction of the flow, `across` the other one.

const SWEEPS = 8;

/** Edges between the same two nodes as one, with all their names. */
export function bundled(edges) {
  const found = new Map();
  for (const { from, to, output, input } of edges) {
    const key = `${from}\n${to}`;
    if (!found.has(key)) found.set(key, { from, to, names: [] });
    const name = output || input;
    const { names } = found.get(key);
    if (!names.includes(name)) names.push(name);
  }
  return [...found.values()];
}

/** The edges that close a circle, found by walking in the order of the nodes. */
function backEdges(ids, edges) {
  const after = new Map(ids.map((id) => [id, []]));
  for (const edge of edges) after.get(edge.from).push(edge);
  const state = new Map();
  const back = new Set();
  const visit = (id) => {
    state.set(id, "open");
    for (const edge of after.get(id)) {
      if (state.get(edge.to) === "open") back.add(edge);
      else if (!state.has(edge.to)) visit(edge.to);
    }
    state.set(id, "done");
  };
  for (const id of ids) if (!state.has(id)) visit(id);
  return back;
}

function layersOf(ids, edges) {
  const layer = new Map(ids.map((id) => [id, 0]));
  // No way is longer than there are nodes.
  for (let round = 0; round < ids.length; round += 1) {
    let moved = false;
    for (const { from, to } of edges) {
      if (layer.get(to) <= layer.get(from)) {
        layer.set(to, layer.get(from) + 1);
        moved = true;
      }
    }
    if (!moved) break;
  }
  // Sources stand right before the first one that they feed.
  for (const id of ids) {
    const takers = edges.filter((edge) => edge.from === id).map((edge) => layer.get(edge.to));
    const isSource = !edges.some((edge) => edge.to === id);
    if (isSource && takers.length) layer.set(id, Math.min(...takers) - 1);
  }
  return layer;
}

const average = (numbers) => numbers.reduce((sum, one) => sum + one, 0) / numbers.length;

/** Moves the places of a layer towards where they want to be, none nearer than it may. */
function settle(places, wishes) {
  places.forEach((place, at) => {
    if (wishes[at] != null) place.across = wishes[at];
  });
  const gap = (a, b) => (a.breadth + b.breadth) / 2;
  for (let at = 1; at < places.length; at += 1) {
    const least = places[at - 1].across + gap(places[at - 1], places[at]);
    places[at].across = Math.max(places[at].across, least);
  }
  const wanted = wishes.map((wish, at) => wish ?? places[at].across);
  const shift = average(places.map((place, at) => wanted[at] - place.across));
  for (const place of places) place.across += shift;
}

/**
 * nodes: {id, length, breadth}, sizes along and across the flow with the room around.
 * edges: {from, to}. Gives {places: id -> {along, across}, ways: one for each edge, points from
 * its beginning to its end, length, breadth, back: the edges against the flow}.
 */
export function layOut(nodes, edges, gap) {
  const ids = nodes.map((node) => node.id);
  const known = new Set(ids);
  const real = edges.filter((edge) => known.has(edge.from) && known.has(edge.to));
  const loops = real.filter((edge) => edge.from === edge.to);
  const straight = real.filter((edge) => edge.from !== edge.to);
  const back = backEdges(ids, straight);
  const onward = straight.map((edge) =>
    back.has(edge) ? { from: edge.to, to: edge.from, edge } : { ...edge, edge });
  const layer = layersOf(ids, onward);
  const layers = [];
  const place = (at, entry) => {
    (layers[at] ??= []).push(entry);
    return entry;
  };
  const byId = new Map();
  for (const node of nodes) {
    const entry = { ...node, layer: layer.get(node.id), before: [], after: [] };
    byId.set(node.id, place(entry.layer, entry));
  }
  const ways = new Map();
  for (const { from, to, edge } of onward) {
    const way = [byId.get(from)];
    for (let at = layer.get(from) + 1; at < layer.get(to); at += 1) {
      way.push(place(at, { layer: at, length: 0, breadth: gap / 2, before: [], after: [] }));
    }
    way.push(byId.get(to));
    for (let at = 1; at < way.length; at += 1) {
      way[at - 1].after.push(way[at]);
      way[at].before.push(way[at - 1]);
    }
    ways.set(edge, back.has(edge) ? way.reverse() : way);
  }
  order(layers);
  spread(layers, gap);
  return { places: byId, ways, loops, back, ...extent(layers) };
}

function order(layers) {
  for (const entries of layers) entries.forEach((entry, at) => (entry.at = at));
  for (let sweep = 0; sweep < SWEEPS; sweep += 1) {
    const side = sweep % 2 ? "after" : "before";
    const sequence = sweep % 2 ? [...layers].reverse() : layers;
    for (const entries of sequence) {
      for (const entry of entries) {
        const near = entry[side];
        entry.rank = near.length ? average(near.map((one) => one.at)) : entry.at;
      }
      entries.sort((a, b) => a.rank - b.rank || a.at - b.at);
      entries.forEach((entry, at) => (entry.at = at));
    }
  }
}

function spread(layers, gap) {
  let along = 0;
  for (const entries of layers) {
    const length = Math.max(...entries.map((entry) => entry.length));
    let across = 0;
    for (const entry of entries) {
      entry.along = along + length / 2;
      entry.across = across + entry.breadth / 2;
      across += entry.breadth;
    }
    for (const entry of entries) entry.across -= across / 2;
    along += length + gap;
  }
  for (let sweep = 0; sweep < SWEEPS; sweep += 1) {
    const side = sweep % 2 ? "after" : "before";
    for (const entries of sweep % 2 ? [...layers].reverse() : layers) {
      settle(entries, entries.map((entry) => {
        const near = entry[side];
        return near.length ? average(near.map((one) => one.across)) : null;
      }));
    }
  }
}

function extent(layers) {
  const all = layers.flat();
  const low = Math.min(...all.map((one) => one.across - one.breadth / 2));
  const high = Math.max(...all.map((one) => one.across + one.breadth / 2));
  for (const one of all) one.across -= low;
  return { length: Math.max(...all.map((one) => one.along + one.length / 2)), breadth: high - low };
}
