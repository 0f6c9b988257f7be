// Making elements. Text goes in as text: nothing that comes from a mission is ever read as markup.

// By digits after the point; making one takes far longer than using it.
const FORMATS = [0, 1, 2, 3].map((digits) => new Intl.NumberFormat("en", { maximumFractionDigits: digits }));
const SVG = "http://www.w3.org/2000/svg";

/** The element with this ID. */
export const at = (id) => document.getElementById(id);

/** An HTML element with attributes and children; a string child is text. */
export function make(name, attributes = {}, ...children) {
  return filled(document.createElement(name), attributes, children);
}

/** The same for SVG. */
export function draw(name, attributes = {}, ...children) {
  return filled(document.createElementNS(SVG, name), attributes, children);
}

/** Set attributes that differ; null removes. */
export function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null) element.removeAttribute(name);
    else if (element.getAttribute(name) !== String(value)) element.setAttribute(name, value);
  }
}

/** Set the text if it differs. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** A number for people: `digits` after the point, fewer for large ones. */
export function shown(value, digits = 1) {
  if (value === null || value === undefined) return "–";
  return FORMATS[Math.abs(value) >= 1000 ? 0 : digits].format(value);
}

function filled(element, attributes, children) {
  set(element, attributes);
  element.append(...children);
  return element;
}
