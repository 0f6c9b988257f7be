// The map over its ground: sensors (disc: queue; ring: urgency), UAVs, and trails in the colour of their latency.

import { latencyScale, onTheme, viridis } from "./colours.js";
import { at, draw, make, say, set, shown } from "./dom.js";
import { best, ground, short, titles } from "./ground.js";
import { latency } from "./model.js";

const MARGIN_PX = 26;
const TRAIL_SEGMENTS = 60;
const MOST_SEGMENTS = 1200;
const FENCES = ["fence", "no_fly"];

export class MissionMap {
  constructor(onChoose) {
    this.svg = at("map");
    this.onChoose = onChoose;
    this.chosen = null;
    this.mission = null;
    this.marks = new Map();
    this.svg.addEventListener("keydown", (event) => this.#move(event));
    this.svg.addEventListener("focusin", (event) => this.#focus(event.target.closest(".mark")));
    this.svg.addEventListener("click", (event) => this.#choose(event.target.closest(".mark")));
    this.svg.addEventListener("pointerover", (event) => this.#hover(event.target.closest(".mark")));
    new ResizeObserver(() => this.mission && this.begin(this.mission)).observe(this.svg);
    onTheme(() => this.mission && this.begin(this.mission));
  }

  /** Draw what stays, and make what moves. */
  begin(mission) {
    const focused = document.activeElement?.closest?.("#map .mark")?.id;
    this.mission = mission;
    this.#fit(mission);
    this.marks.clear();
    this.legendTold = null;
    this.trails = draw("g", { class: "trails", "aria-hidden": "true" });
    this.links = draw("g", { class: "links", "aria-hidden": "true" });
    const sensors = draw("g", {});
    const uavs = draw("g", {});
    const { places } = mission;
    this.radius = (places.length <= 30 ? 11 : places.length <= 150 ? 8 : places.length <= 1000 ? 4 : 2.5) * (this.width < 500 ? 0.75 : 1);
    const r = this.radius;
    this.boxes = places.flatMap((place) => (place[0] === null ? [] : [[this.x(place[0]) - r, this.y(place[1]) - r, 2 * r, 2 * r]]));
    const under = ground(mission, this);
    places.forEach((place, id) => place[0] !== null && sensors.append(this.#sensor(id, place)));
    this.uavs = uavs;
    this.svg.replaceChildren(under, this.trails, this.links, titles(mission, this), sensors, uavs);
    this.segments = new Map();
    this.update(mission);
    set(this.svg.querySelector(".mark") ?? this.svg, { tabindex: 0 });
    if (focused) at(focused)?.focus();
  }

  /** Move what moved. */
  update(mission) {
    const { queue, urgency, heard, visits, uavs, step } = mission.now;
    if (Object.values(uavs).some(this.beyond)) {
      this.begin(mission);
      return;
    }
    const capacity = mission.scenario.queue_capacity;
    for (const mark of this.marks.values()) {
      if (mark.kind !== "sensor") continue;
      const { id } = mark;
      const told = [queue[id], urgency[id], heard[id], visits[id]].join();
      if (told === mark.told) continue;
      mark.told = told;
      const full = Math.min(1, queue[id] / capacity);
      set(mark.disc, { r: px(this.radius * 0.78 * Math.sqrt(full)) });
      set(mark.ring, { "stroke-dasharray": `${(urgency[id] ?? 0).toFixed(3)} 2` });
      mark.group.classList.toggle("unheard", heard[id] < 0);
      const known = heard[id] < 0 ? "never heard" : `last heard at step ${heard[id]}`;
      const visit = visits[id] < 0 ? "no visit" : `last visit at step ${visits[id]}`;
      const held = heard[id] < 0 ? `queue unknown, taken for ${shown(queue[id])} of ${capacity} packets` : `queue ${shown(queue[id])} of ${capacity} packets, ${fullIn(mission.now.full_in[id])}`;
      const left = heard[id] < 0 ? "battery unknown" : `battery ${shown(100 * mission.now.battery[id], 0)}%`;
      mark.text = `${this.#named("Sensor", id, mission.names?.sensors[id])}: ${held}, urgency ${(urgency[id] ?? 0).toFixed(2)}, ${known}, ${visit}, ${left}`;
      set(mark.group, { "aria-label": mark.text });
    }
    const newest = this.#paths(mission);
    this.#fly(mission, uavs, newest, step);
    const described = this.marks.get(this.chosen);
    say(at("readout"), described?.text ?? "Point at a sensor or a UAV, or move with the arrow keys, to read its numbers.");
  }

  #named(kind, id, name) {
    return name ? `${name} (${kind === "UAV" ? kind : kind.toLowerCase()} ${id})` : `${kind} ${id}`;
  }

  #fit(mission) {
    const points = [...mission.trajectories.flat(), ...mission.map.filter(({ kind }) => FENCES.includes(kind)).flatMap((one) => one.points)];
    points.push(...mission.pipeline, ...mission.places.filter((place) => place[0] !== null));
    const least = (axis) => points.reduce((low, p) => Math.min(low, p[axis]), Infinity);
    const most = (axis) => points.reduce((high, p) => Math.max(high, p[axis]), -Infinity);
    // A UAV off its path is within the map, unless it is so far away that all else would be too small.
    const size = Math.max(most(0) - least(0), most(1) - least(1));
    const around = [0, 1].map((axis) => [least(axis) - size, most(axis) + size]);
    const within = (value, [low, high]) => Math.min(high, Math.max(low, value));
    points.push(...Object.values(mission.now.uavs).map(({ position }) => position.map((value, axis) => within(value, around[axis]))));
    const low = [0, 1].map(least);
    const high = [0, 1].map(most);
    // A world along one parallel or meridian has a height or width too.
    high.forEach((most, axis) => most > low[axis] || (high[axis] = low[axis] + 1));
    const width = Math.max(200, this.svg.clientWidth);
    this.scale = (width - 2 * MARGIN_PX) / (high[0] - low[0]);
    const tallest = Math.min(width * 1.25, Math.max(320, 0.62 * innerHeight));
    const height = Math.min(tallest, (high[1] - low[1]) * this.scale + 2 * MARGIN_PX);
    this.scale = Math.min(this.scale, (height - 2 * MARGIN_PX) / (high[1] - low[1]));
    const left = (width - (high[0] - low[0]) * this.scale) / 2;
    this.x = (x) => px(left + (x - low[0]) * this.scale);
    this.y = (y) => px(height - MARGIN_PX - (y - low[1]) * this.scale);
    this.drawn = (position) => position.map((value, axis) => within(value, [low[axis], high[axis]]));
    this.beyond = ({ position }) => position.some((value, axis) => value !== within(value, [low[axis], high[axis]]) && value === within(value, around[axis]));
    set(this.svg, { viewBox: `0 0 ${width} ${Math.round(height)}` });
    [this.width, this.height, this.left] = [width, height, MARGIN_PX];
  }

  #sensor(id, [x, y]) {
    const r = this.radius;
    const disc = draw("circle", { class: "queue", r: 0 });
    const ring = draw("circle", { class: "urgency", r, pathLength: 1, transform: "rotate(-90)", "stroke-width": Math.max(1.5, r * 0.34) });
    const parts = [draw("circle", { class: "hit", r: Math.max(12, r * 1.6) }), draw("circle", { class: "body", r }), disc, ring];
    if (r >= 8) parts.push(...this.#label(id, r));
    const attributes = { class: "mark sensor", id: `sensor-${id}`, role: "button", tabindex: -1, transform: `translate(${this.x(x)} ${this.y(y)})` };
    const group = draw("g", attributes, ...parts);
    this.marks.set(group.id, { kind: "sensor", id, group, disc, ring, text: "" });
    return group;
  }

  /** A sensor's label at the place beside it that covers least, if any is free; its readout has the whole name. */
  #label(id, r) {
    const [x, y] = [this.x(this.mission.places[id][0]), this.y(this.mission.places[id][1])];
    const text = short(this.mission.sensor(id));
    const aside = r + 5 + 3.2 * text.length;
    const spot = best(this, [[x, y - r - 7], [x, y + r + 8], [x + aside, y], [x - aside, y]], text, 0.1);
    return spot ? [draw("text", { class: "label", x: px(spot[0] - x), y: px(spot[1] - y + 4) }, text)] : [];
  }

  #uav(id) {
    const body = draw("path", { class: "craft", d: "M0-11L8 8 0 4-8 8z" });
    const label = draw("text", { class: "label" }, short(this.mission.uav(id), 11));
    const attributes = { class: "mark uav", id: `uav-${id}`, role: "button", tabindex: -1 };
    const group = draw("g", attributes, draw("circle", { class: "hit", r: 16 }), body, label);
    const link = draw("line", { class: "link" });
    this.uavs.append(group);
    this.links.append(link);
    const mark = { kind: "uav", id, group, body, label, link, text: "" };
    this.marks.set(group.id, mark);
    return mark;
  }

  /** Put a UAV's label beside it where it covers the fewest sensors and names. */
  #aside(label, x, y) {
    const text = label.textContent;
    const aside = 14 + 3.6 * text.length;
    const [bestX, bestY] = best(this, [[x + aside, y - 8], [x - aside, y - 8], [x + aside, y + 10], [x - aside, y + 10], [x, y - 20], [x, y + 22]], text, Infinity, false) ?? [x, y - 20];
    set(label, { x: px(bestX - x), y: px(bestY - y + 4) });
  }

  #fly(mission, uavs, newest, step) {
    for (const [id, { position: believed, step: reported, position_step: of }] of Object.entries(uavs)) {
      const position = this.drawn(believed);
      const mark = this.marks.get(`uav-${id}`) ?? this.#uav(id);
      const last = newest.get(Number(id));
      const place = `translate(${this.x(position[0])} ${this.y(position[1])})`;
      if (place !== mark.place) {
        mark.place = place;
        set(mark.group, { transform: place });
        this.#aside(mark.label, this.x(position[0]), this.y(position[1]));
      }
      const heading = last?.before ? Math.atan2(position[0] - last.before[0], position[1] - last.before[1]) : null;
      if (heading !== null) set(mark.body, { transform: `rotate(${Math.round((heading * 180) / Math.PI)})` });
      mark.group.classList.toggle("away", reported < step - 1);
      const answer = last?.decision.answer;
      const sensor = answer && mission.places[answer.sensor_id];
      const shownLink = sensor && sensor[0] !== null && reported >= step - 1;
      set(mark.link, shownLink
        ? { x1: this.x(position[0]), y1: this.y(position[1]), x2: this.x(sensor[0]), y2: this.y(sensor[1]), visibility: null }
        : { visibility: "hidden" });
      const told = answer ? `collects from ${mission.names?.sensors[answer.sensor_id] ?? `sensor ${answer.sensor_id}`} at ${answer.velocity} m/s, decided by ${answer.source} in ${shown(latency(last.decision))} ms` : "not told anything yet";
      mark.text = `${this.#named("UAV", id, mission.names?.uavs[id])} at step ${reported}, ${of > reported ? `believed at step ${of} ` : ""}${shown(believed[0], 0)} m east, ${shown(believed[1], 0)} m north: ${told}`;
      set(mark.group, { "aria-label": mark.text });
    }
  }

  /** Trails; returns each UAV's newest decision, and where it was before. */
  #paths(mission) {
    const byUav = new Map();
    for (const decision of mission.decisions.values()) {
      const id = decision.answer.uav_id;
      if (!byUav.has(id)) byUav.set(id, []);
      byUav.get(id).push(decision);
    }
    const most = Math.min(TRAIL_SEGMENTS, Math.floor(MOST_SEGMENTS / Math.max(1, byUav.size)));
    const wanted = new Map();
    const newest = new Map();
    for (const [id, flown] of byUav) {
      const shownOf = flown.slice(-most);
      shownOf.forEach((decision, i) => {
        const to = shownOf[i + 1]?.position ?? mission.now.uavs[id]?.position;
        if (to && (to[0] !== decision.position[0] || to[1] !== decision.position[1])) {
          wanted.set(decision.answer.decision_id, { decision, to });
        }
      });
      const last = flown.at(-1);
      const here = mission.now.uavs[id]?.position ?? last.position;
      const moved = flown.findLast((d) => Math.hypot(d.position[0] - here[0], d.position[1] - here[1]) > 1);
      newest.set(id, { decision: last, before: moved?.position });
    }
    this.#trail(wanted);
    return newest;
  }

  #trail(wanted) {
    for (const [id, segment] of this.segments) {
      if (!wanted.has(id)) {
        segment.line.remove();
        this.segments.delete(id);
      }
    }
    const scale = latencyScale([...wanted.values()].map(({ decision }) => latency(decision)));
    for (const [id, { decision, to }] of wanted) {
      let segment = this.segments.get(id);
      if (!segment) {
        segment = { line: draw("line", { x1: this.x(decision.position[0]), y1: this.y(decision.position[1]) }) };
        this.segments.set(id, segment);
        this.trails.append(segment.line);
      }
      const told = [...to, latency(decision), scale.low, scale.high].join();
      if (told === segment.told) continue;
      segment.told = told;
      set(segment.line, { x2: this.x(to[0]), y2: this.y(to[1]), stroke: viridis(scale.share(latency(decision))) });
    }
    this.#legend(scale);
  }

  #legend(scale) {
    const { measured, seen } = this.mission.totals;
    const whose = measured === 0 ? "the edge's own time: these UAVs do not report their round trip" : measured < seen ? "round trip as the UAV measured it; the edge's own time where it has not reported one" : "round trip as the UAV measured it";
    const told = [scale.low, scale.high, whose].join();
    if (told === this.legendTold) return;
    this.legendTold = told;
    const stops = [...Array(9).keys()].map((i) => draw("stop", { offset: i / 8, "stop-color": viridis(i / 8) }));
    const bar = draw("svg", { class: "scale", width: 120, height: 10, "aria-hidden": "true" },
      draw("linearGradient", { id: "viridis" }, ...stops), draw("rect", { width: 120, height: 10, rx: 3, fill: "url(#viridis)" }));
    const key = (picture, ...words) => make("span", { class: "key" }, picture, ...words);
    at("legend").replaceChildren(
      key(draw("svg", { width: 26, height: 26, viewBox: "-13 -13 26 26", "aria-hidden": "true" },
        draw("g", { class: "sensor" }, draw("circle", { class: "body", r: 10 }), draw("circle", { class: "queue", r: 6.5 }))), "disc: queue, its area is full at the capacity"),
      key(draw("svg", { width: 26, height: 26, viewBox: "-13 -13 26 26", "aria-hidden": "true" },
        draw("g", { class: "sensor" }, draw("circle", { class: "body", r: 10 }),
          draw("circle", { class: "urgency", r: 10, pathLength: 1, "stroke-dasharray": "0.7 2", transform: "rotate(-90)", "stroke-width": 3.4 }))), "ring: urgency; a full circle is 1"),
      key(draw("svg", { width: 26, height: 26, viewBox: "-13 -13 26 26", "aria-hidden": "true" },
        draw("g", { class: "uav" }, draw("path", { class: "craft", d: "M0-11L8 8 0 4-8 8z" }))), "UAV, and the sensor that it collects from"),
      ...FENCES.filter((kind) => this.mission.map.some((one) => one.kind === kind)).map((kind) =>
        key(draw("svg", { width: 26, height: 14, "aria-hidden": "true" }, draw("rect", { class: `shape ${kind}`, x: 2, y: 2, width: 22, height: 10 })), kind === "fence" ? "fence: not to be left" : "no-fly area")),
      key(bar, `trail: ${shown(scale.low)} to ${shown(scale.high)} ms, ${whose}`));
  }

  #move(event) {
    const marks = [...this.svg.querySelectorAll(".mark")];
    const here = marks.indexOf(document.activeElement);
    const steps = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };
    if (event.key === "Enter" || event.key === " ") {
      event.preventDefault();
      this.#choose(document.activeElement.closest(".mark"));
    } else if (here >= 0 && (event.key in steps || event.key === "Home" || event.key === "End")) {
      event.preventDefault();
      const there = event.key === "Home" ? 0 : event.key === "End" ? marks.length - 1 : (here + steps[event.key] + marks.length) % marks.length;
      marks[there].focus();
    }
  }

  #focus(group) {
    if (!group) return;
    for (const one of this.svg.querySelectorAll('.mark[tabindex="0"]')) set(one, { tabindex: -1 });
    set(group, { tabindex: 0 });
    this.#hover(group);
  }

  #hover(group) {
    if (!group) return;
    this.chosen = group.id;
    say(at("readout"), this.marks.get(group.id)?.text ?? "");
  }

  #choose(group) {
    if (!group) return;
    this.#hover(group);
    const { kind, id } = this.marks.get(group.id);
    this.onChoose(kind, Number(id));
  }
}

function fullIn(steps) {
  if (steps <= 0) return "believed full";
  return steps > 1000 ? "not filling" : `full in about ${shown(steps)} steps`;
}

const px = (value) => Math.round(value * 100) / 100;
