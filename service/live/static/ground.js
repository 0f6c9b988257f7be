// What lies under the map's sensors and UAVs: the user's own lines and areas, pipeline, trajectories, scale and north.

import { draw } from "./dom.js";

const BARS_M = [10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 50_000, 100_000];
const LETTER_PX = 6.3;
const LABEL_PX = 12;
const MOST_LETTERS = 16;

/** A mission's ground in a view `{x, y, scale, width, height, left, boxes}`; its labels keep clear of the boxes. */
export function ground(mission, view) {
  const side = mission.scenario.area_m;
  const made = draw("g", { "aria-hidden": "true" });
  made.append(line(view, [[0, 0], [side, 0], [side, side], [0, side], [0, 0]], { class: "area" }));
  made.append(...mission.map.filter(({ kind }) => kind !== "line").map((one) => shape(view, one)));
  if (mission.pipeline.length) made.append(line(view, mission.pipeline, { class: "pipeline" }));
  made.append(...mission.map.filter(({ kind }) => kind === "line").map((one) => shape(view, one)));
  made.append(...mission.trajectories.map((curve) => line(view, curve, { class: "trajectory" })));
  const metres = BARS_M.findLast((m) => m * view.scale < 130) ?? 10;
  const [x, y] = [view.left, view.height - 8];
  made.append(draw("path", { class: "bar", d: `M${x} ${y - 4}v4h${px(metres * view.scale)}v-4` }));
  made.append(draw("text", { class: "bar-text", x: x + 6, y: y - 5 }, `${metres.toLocaleString("en")} m`));
  made.append(draw("path", { class: "north", d: "M0-9L5 7 0 3-5 7z", transform: `translate(${view.width - 16} 27)` }));
  made.append(draw("text", { class: "bar-text middle", x: view.width - 16, y: 13 }, "N"));
  view.boxes.push([view.width - 28, 0, 28, 38], [x, y - 16, metres * view.scale, 18]);
  return made;
}

/** The names of the user's lines and areas, where there is room for them. */
export function titles(mission, view) {
  const made = draw("g", { "aria-hidden": "true" });
  const told = new Set();
  for (const { kind, name, points } of mission.map) {
    if (name === null || told.has(`${kind}${name}`)) continue;
    const inside = points.map(([x, y]) => [view.x(x), view.y(y)]).filter(([x, y]) => x > 0 && y > 0 && x < view.width && y < view.height);
    const spots = kind === "fence" ? inside.flatMap(([x, y]) => [[x + 40, y - 10], [x - 40, y - 10], [x + 40, y + 10], [x - 40, y + 10]]) : kind === "line" ? [0.5, 0.25, 0.75].map((share) => inside[Math.floor(share * (inside.length - 1))]) : [middle(inside), ...inside];
    const text = short(name);
    const spot = best(view, spots.filter(Boolean).flatMap(([x, y]) => [[x, y], [x, y - 14], [x, y + 14]]), text, 0.05);
    if (!spot) continue;
    told.add(`${kind}${name}`);
    made.append(draw("text", { class: "title", x: px(spot[0]), y: px(spot[1] + 4) }, text));
  }
  return made;
}

/** Of the places of a text's middle the one that covers least; null where each covers more than a share of the text.
 * `stays`: whether other texts are to keep clear of it. */
export function best(view, spots, text, share, stays = true) {
  const [w, h] = [LETTER_PX * text.length + 4, LABEL_PX];
  let [found, least] = [null, share * w * h];
  for (const [x, y] of spots) {
    const box = [x - w / 2, y - h / 2, w, h];
    const out = Math.max(0, -box[0]) + Math.max(0, box[0] + w - view.width) + Math.max(0, -box[1]) + Math.max(0, box[1] + h - view.height);
    const cost = view.boxes.reduce((sum, other) => sum + covered(box, other), out * h);
    if (cost < least || (cost === 0 && !found)) [found, least] = [[x, y, box], cost];
    if (cost === 0) break;
  }
  if (found && stays) view.boxes.push(found[2]);
  return found;
}

/** A name that fits on the map. */
export const short = (name, most = MOST_LETTERS) => (name.length > most ? `${name.slice(0, most - 1).trimEnd()}…` : name);

function shape(view, { kind, points }) {
  const closed = kind === "line" ? points : [...points, points[0]];
  return line(view, closed, { class: `shape ${kind}` });
}

function line(view, points, attributes) {
  return draw("polyline", { points: points.map(([x, y]) => `${view.x(x)},${view.y(y)}`).join(" "), ...attributes });
}

function middle(points) {
  return points.length ? [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length) : null;
}

function covered([x, y, w, h], [ox, oy, ow, oh]) {
  return Math.max(0, Math.min(x + w, ox + ow) - Math.max(x, ox)) * Math.max(0, Math.min(y + h, oy + oh) - Math.max(y, oy));
}

const px = (value) => Math.round(value * 100) / 100;
