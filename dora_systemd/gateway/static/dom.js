// Elements out of tags, attributes and text. Whatever comes from outside is text, never markup.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value === true) node.setAttribute(name, "");
    else if (value !== false && value != null) node.setAttribute(name, value);
  }
  node.append(...children.filter((child) => child != null));
  return node;
}

export const el = (tag, attributes = {}, ...children) =>
  fill(document.createElement(tag), attributes, children);

export const svg = (tag, attributes = {}, ...children) =>
  fill(document.createElementNS(SVG, tag), attributes, children);

/** Sets the text only where it is another one: a selection by hand stays. null is no text. */
export function say(node, text) {
  if (node.textContent !== (text ?? "")) node.textContent = text;
}

/** The children of `parent` in the order of `keys`; each is made once, and kept. */
export function arrange(parent, known, keys, make) {
  for (const [key, row] of known) {
    if (keys.includes(key)) continue;
    row.node.remove();
    known.delete(key);
  }
  keys.forEach((key, at) => {
    if (!known.has(key)) known.set(key, make(key));
    const { node } = known.get(key);
    if (parent.children[at] !== node) parent.insertBefore(node, parent.children[at] ?? null);
  });
}
