"use strict";
// The playback of a mission: a map and two tables at the step that the slider names. Text goes in as text, never as markup.
{
  const WIDTH = 1000;
  const MARGIN = 60;
  // Labels, and a table row for each sensor, up to so many; of more sensors the table has the fullest.
  const FEW = 20;
  const SHORTEST_MS = 60, LONGEST_MS = 700, WHOLE_MS = 20_000;

  const at = (id) => document.getElementById(id);
  const mission = JSON.parse(at("playback-data").textContent);
  const { frames, sensors } = mission;
  const [map, slider, button] = [at("playback-map"), at("playback-step"), at("playback-play")];

  function filled(element, attributes, children) {
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
  }
  const draw = (name, attributes, ...children) => filled(document.createElementNS(map.namespaceURI, name), attributes, children);
  const make = (name, attributes, ...children) => filled(document.createElement(name), attributes, children);
  const packets = (count) => `${count.toLocaleString("en")} packet${count === 1 ? "" : "s"}`;
  const sensorName = (id) => mission.names?.sensors[id] ?? `S${id}`;
  const uavName = (id) => mission.names?.uavs[id] ?? `U${id}`;
  const short = (name) => (name.length > 12 ? `${name.slice(0, 11)}…` : name);
  const total = (numbers) => numbers.reduce((sum, one) => sum + one, 0);

  const points = [...mission.trajectories.flat(), ...mission.pipeline, ...sensors, ...frames.flatMap(({ uavs }) => uavs.map(([, x, y]) => [x, y]))];
  const low = [0, 1].map((axis) => points.reduce((least, point) => Math.min(least, point[axis]), Infinity));
  const high = [0, 1].map((axis) => points.reduce((most, point) => Math.max(most, point[axis]), -Infinity));
  const scale = (WIDTH - 2 * MARGIN) / Math.max(high[0] - low[0], (high[1] - low[1]) / 1.2, 1);
  const height = Math.max(300, (high[1] - low[1]) * scale + 2 * MARGIN);
  const middle = [0, 1].map((axis) => (low[axis] + high[axis]) / 2);
  const place = ([x, y]) => [(WIDTH / 2 + (x - middle[0]) * scale).toFixed(1), (height / 2 - (y - middle[1]) * scale).toFixed(1)];
  const line = (curve, name) => draw("polyline", { class: name, points: curve.map((point) => place(point).join()).join(" ") });
  const move = (group, point) => group.setAttribute("transform", `translate(${place(point).join(" ")})`);

  const radius = sensors.length <= FEW ? 26 : sensors.length <= 150 ? 15 : sensors.length <= 1000 ? 8 : 4;
  const discs = sensors.map((point, id) => {
    const disc = draw("circle", { class: "queue", r: 0 });
    const group = draw("g", { class: "sensor" }, draw("circle", { class: "body", r: radius }), disc);
    if (sensors.length <= FEW) group.append(draw("text", { y: -radius - 10 }, short(sensorName(id))));
    move(group, point);
    return { group, disc };
  });
  const crafts = new Map();
  const links = draw("g", {});
  const fleet = draw("g", {});
  map.setAttribute("viewBox", `0 0 ${WIDTH} ${Math.round(height)}`);
  map.append(line(mission.pipeline, "pipeline"), ...mission.trajectories.map((curve) => line(curve, "trajectory")));
  map.append(links, ...discs.map(({ group }) => group), fleet);

  function craft(id) {
    if (!crafts.has(id)) {
      const body = draw("path", { d: "M0-26L23 18H-23z" });
      const label = draw("text", {}, short(uavName(id)));
      const group = draw("g", { class: "uav" }, body, label);
      const link = draw("line", {});
      fleet.append(group);
      links.append(link);
      crafts.set(id, { group, label, link });
    }
    return crafts.get(id);
  }

  // What a UAV's label should not cover: the sensors, and their own labels.
  const covered = sensors.length > FEW ? [] : sensors.flatMap((point) => {
    const [x, y] = place(point).map(Number);
    return [[x, y], [x, y - radius - 20]];
  });

  /** Of the places about a UAV the one farthest from the sensors, relative to the UAV. */
  function spot([x, y]) {
    const free = ([dx, dy]) => covered.reduce((least, other) => Math.min(least, Math.hypot(x + dx - other[0], y + dy - 10 - other[1])), 90);
    const [dx, dy] = [[0, 50], [46, 20], [-46, 20], [0, -36]].reduce((best, one) => (free(one) > free(best) ? one : best));
    return { x: dx, y: dy };
  }

  function showSensors(frame, before) {
    discs.forEach(({ group, disc }, id) => {
      const share = Math.min(1, frame.queue[id] / mission.capacity);
      disc.setAttribute("r", (radius * Math.sqrt(share)).toFixed(1));
      group.classList.toggle("lost", frame.lost[id] > before.lost[id]);
    });
    const shown = sensors.map((_, id) => id);
    if (sensors.length > FEW) shown.sort((a, b) => frame.queue[b] - frame.queue[a] || a - b).splice(FEW);
    const rows = shown.map((id) => [sensorName(id), `${frame.queue[id]} of ${mission.capacity}`, `${frame.battery[id]} %`, frame.lost[id]]);
    fill("playback-sensors", rows);
  }

  function showUavs(frame) {
    const chosen = new Map(frame.decisions.map((decision) => [decision[0], decision]));
    for (const { group, link } of crafts.values()) group.style.display = link.style.display = "none";
    for (const [id, x, y] of frame.uavs) {
      const { group, label, link } = craft(id);
      group.style.display = "";
      move(group, [x, y]);
      filled(label, spot(place([x, y]).map(Number)), []);
      const decision = chosen.get(id);
      if (!decision) continue;
      const [from, to] = [place([x, y]), place(sensors[decision[1]])];
      link.style.display = "";
      filled(link, { x1: from[0], y1: from[1], x2: to[0], y2: to[1], class: decision[4] ? "failed" : "served" }, []);
    }
    const rows = frame.decisions.map(([id, sensor, velocity, source, failed, collected, , cost]) =>
      [uavName(id), sensorName(sensor), velocity, source, failed ? "failed" : collected, cost.toFixed(2)]);
    fill("playback-uavs", rows);
    at("playback-decisions").hidden = rows.length === 0;
  }

  function fill(id, rows) {
    const cells = ([name, ...rest]) => [make("th", { scope: "row" }, name), ...rest.map((cell) => make("td", {}, String(cell)))];
    at(id).replaceChildren(...rows.map((row) => make("tr", {}, ...cells(row))));
  }

  function show(index) {
    const frame = frames[index];
    const before = frames[Math.max(0, index - 1)];
    const lost = total(frame.lost);
    slider.value = index;
    const now = index < frames.length - 1 ? `Step ${frame.step} of ${mission.steps}` : `End, after ${frame.step} steps`;
    slider.setAttribute("aria-valuetext", `${now}, ${packets(lost)} lost`);
    at("playback-now").textContent = now;
    at("playback-lost").textContent = `${packets(lost)} lost so far${index ? ` (${lost - total(before.lost)} since step ${before.step})` : ""}`;
    at("playback-queued").textContent = `${packets(total(frame.queue))} waiting`;
    showSensors(frame, before);
    showUavs(frame);
  }

  let timer = null;
  const pace = Math.min(LONGEST_MS, Math.max(SHORTEST_MS, WHOLE_MS / frames.length));

  function pause() {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  }

  function play() {
    if (Number(slider.value) === frames.length - 1) show(0);
    button.textContent = "Pause";
    timer = setInterval(() => {
      show(Number(slider.value) + 1);
      if (Number(slider.value) === frames.length - 1) pause();
    }, pace);
  }

  const toggle = () => (timer === null ? play() : pause());
  const jumps = {
    ArrowLeft: (now) => now - 1,
    ArrowDown: (now) => now - 1,
    ArrowRight: (now) => now + 1,
    ArrowUp: (now) => now + 1,
    Home: () => 0,
    End: () => frames.length - 1,
  };

  button.addEventListener("click", toggle);
  slider.addEventListener("input", () => {
    pause();
    show(Number(slider.value));
  });
  at("playback-controls").addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey) return;
    const jump = jumps[event.key];
    // A button takes the space bar itself.
    if (jump) {
      pause();
      show(Math.min(frames.length - 1, Math.max(0, jump(Number(slider.value)))));
    } else if (event.key === " " && event.target !== button) toggle();
    else return;
    event.preventDefault();
  });

  slider.max = frames.length - 1;
  show(0);
  at("playback-player").hidden = false;
}
