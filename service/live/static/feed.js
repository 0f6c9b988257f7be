// The decisions as a list, the newest first. Whoever reads or has chosen one keeps it: nothing under the focus is removed.

import { at, make, say, shown } from "./dom.js";
import { measured } from "./model.js";
import { decider, SOURCES, why } from "./words.js";

const MOST_SHOWN = 100;
const FILTERS = ["uav", "sensor", "source"];

export class Feed {
  constructor(onOpen) {
    this.list = at("feed");
    this.items = new Map();
    this.onOpen = onOpen;
    this.list.addEventListener("click", (event) => {
      const button = event.target.closest("button");
      if (button) this.onOpen(button.dataset.decision);
    });
    this.list.addEventListener("keydown", (event) => this.#move(event));
    for (const name of FILTERS) at(`filter-${name}`).addEventListener("change", () => {
      this.#clear();
      if (this.mission) this.update(this.mission);
    });
  }

  /** Begin with another mission. */
  begin() {
    this.#clear();
    for (const name of FILTERS) at(`filter-${name}`).value = "";
  }

  #clear() {
    this.items.clear();
    this.list.replaceChildren();
  }

  /** The decisions that the filters let pass, the newest first. */
  #chosen(mission) {
    if (this.offered !== mission) {
      this.offered = mission;
      this.sources = -1;
      offer("uav", [...Array(mission.scenario.uavs).keys()].map((id) => [id, mission.uav(id)]));
      offer("sensor", [...mission.places.keys()].map((id) => [id, mission.sensor(id)]));
    }
    if (this.sources !== mission.sources.size) {
      this.sources = mission.sources.size;
      offer("source", [...mission.sources.keys()].map((source) => [source, SOURCES[source] ?? source]));
    }
    const [uav, sensor, source] = FILTERS.map((name) => at(`filter-${name}`).value);
    const passes = ({ answer }) => (uav === "" || answer.uav_id === Number(uav)) && (sensor === "" || answer.sensor_id === Number(sensor)) && (source === "" || answer.source === source);
    return [...mission.decisions.values()].filter(passes).slice(-MOST_SHOWN).reverse();
  }

  update(mission) {
    this.mission = mission;
    const newest = this.#chosen(mission);
    at("feed-none").hidden = newest.length > 0;
    say(at("feed-none"), mission.decisions.size ? "None of the newest decisions is such a one." : "None yet.");
    const wanted = new Set(newest.map((decision) => decision.answer.decision_id));
    for (const [id, item] of this.items) {
      if (!wanted.has(id) && !item.element.contains(document.activeElement)) {
        item.element.remove();
        this.items.delete(id);
      }
    }
    for (const decision of newest.reverse()) {
      const id = decision.answer.decision_id;
      const item = this.items.get(id);
      if (!item) this.#add(id, decision);
      else if (decision.outcome && !item.settled) this.#settle(item, decision);
    }
  }

  #add(id, decision) {
    const { answer } = decision;
    const meta = make("span", { class: "meta" });
    const button = make("button", { type: "button", "data-decision": id, "aria-haspopup": "dialog" },
      make("span", { class: "what" }, make("b", {}, this.mission.uav(answer.uav_id)), ` to `, make("b", {}, this.mission.sensor(answer.sensor_id)), ` at ${answer.velocity} m/s`),
      make("span", { class: "step" }, `step ${answer.step}`),
      make("span", { class: "by" }, make("span", { class: "who", "data-source": answer.source }, decider(answer)), ` ${why(answer)}`),
      meta);
    const item = { element: make("li", {}, button), meta, settled: false };
    this.items.set(id, item);
    this.list.prepend(item.element);
    this.#settle(item, decision);
  }

  #settle(item, decision) {
    const { answer, outcome } = decision;
    const roundTrip = measured(decision);
    const time = roundTrip === null ? `${shown(answer.latency_ms.total)} ms at the edge` : `${shown(roundTrip)} ms round trip`;
    const parts = [time];
    if (outcome) parts.push(outcome.failed ? `failed, cost ${shown(outcome.cost, 2)}` : `cost ${shown(outcome.cost, 2)}`);
    say(item.meta, parts.join(" · "));
    item.meta.classList.toggle("failed", Boolean(outcome?.failed));
    item.settled = Boolean(outcome);
  }

  #move(event) {
    const item = event.target.closest("li");
    const to = { ArrowDown: item?.nextElementSibling, ArrowUp: item?.previousElementSibling, Home: this.list.firstElementChild, End: this.list.lastElementChild }[event.key];
    if (!to) return;
    event.preventDefault();
    to.querySelector("button").focus();
  }
}

/** Fill a filter with values and their names; what was chosen stays. */
function offer(filter, options) {
  const select = at(`filter-${filter}`);
  const { value } = select;
  select.replaceChildren(make("option", { value: "" }, "all"), ...options.map(([id, name]) => make("option", { value: id }, name)));
  select.value = value;
}
