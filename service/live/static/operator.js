// The operator's console: give a note, read what was understood, confirm or reject it, and see which deadlines are met.

import { at, make, say } from "./dom.js";
import { post, Refused } from "./edge.js";
import { GUIDANCE } from "./words.js";

const EXAMPLE = '{"sensors": [{"sensor_id": 4, "visit_every": 3}], "max_velocity": 10}';

export class Operator {
  constructor() {
    this.mission = null;
    this.busy = false;
    at("note-form").addEventListener("submit", (event) => this.#submit(event, () => ({ note: at("note-input").value.trim() }), at("note-input")));
    at("orders-form").addEventListener("submit", (event) => this.#submit(event, () => ({ guidance: JSON.parse(at("orders-input").value) }), null));
    // Refused where another operator was faster: what is answered is what the page shows, also while its view is frozen.
    for (const answer of ["confirm", "reject"]) at(answer).addEventListener("click", () => this.#send({ answer, version: this.version }));
    at("withdraw").addEventListener("click", () => this.#send({ answer: "withdraw" }));
    at("edit").addEventListener("click", () => this.#edit());
    at("orders-input").placeholder = EXAMPLE;
  }

  /** Begin with another mission. */
  begin() {
    say(at("operator-error"), "");
    at("operator").open = false;
    this.seen = null;
  }

  /** Show a mission's guidance. */
  update(mission, mayCommand) {
    this.mission = mission;
    const { guidance, deadlines, step } = mission.now;
    const waits = guidance.status === "proposed";
    const inForce = Boolean(guidance.obeyed_in_words);
    this.version = guidance.version;
    say(at("operator-summary"), summary(guidance, waits));
    at("note").hidden = guidance.note === null && guidance.guidance === null;
    at("note-quote").hidden = guidance.note === null;
    say(at("note-text"), guidance.note ?? "");
    say(at("note-state"), guidance.note === null ? "Orders without a note." : GUIDANCE[guidance.status] ?? guidance.status);
    const orders = waits ? guidance.in_words : guidance.status === "failed" ? guidance.failure : "";
    say(at("note-words"), orders ?? "");
    at("note-words").hidden = !orders;
    say(at("note-doubts"), waits ? (guidance.doubts ?? []).join(" ") : "");
    at("note-doubts").hidden = !at("note-doubts").textContent;
    say(at("note-changes"), waits && inForce ? changes(guidance) : "");
    at("note-changes").hidden = !at("note-changes").textContent;
    at("answer").hidden = !mayCommand || !(waits || inForce);
    at("confirm").hidden = at("reject").hidden = !waits;
    at("withdraw").hidden = !inForce;
    at("edit").hidden = guidance.guidance === null;
    at("command").hidden = !mayCommand;
    at("read-only").hidden = mayCommand;
    this.#orders(guidance, deadlines, step);
    // Once for each proposal: who closes the console wants it closed.
    if (waits && this.seen !== guidance.in_words) at("operator").open = true;
    this.seen = waits ? guidance.in_words : null;
  }

  #orders(guidance, deadlines, step) {
    say(at("orders-words"), guidance.obeyed_in_words ?? "None.");
    say(at("orders-ended"), guidance.ended.length ? `Ended by the last change: ${guidance.ended.join(" ")}` : "");
    at("orders-ended").hidden = guidance.ended.length === 0;
    const due = guidance.orders.filter((order) => order.due !== null);
    at("deadlines").hidden = due.length + deadlines.met + deadlines.missed === 0;
    say(at("deadlines-met"), `Visit deadlines of the steps that are over: ${deadlines.met} met, ${deadlines.missed} missed.`);
    const rows = due.map((order) => {
      const late = order.due < step;
      const text = late ? `late: it was due by step ${order.due}` : `due by step ${order.due}`;
      return make("li", late ? { class: "late" } : {}, `S${order.sensor_id}, every ${order.visit_every} steps: ${text}`);
    });
    at("deadlines-list").replaceChildren(...rows);
  }

  #edit() {
    const { guidance } = this.mission.now.guidance;
    at("orders-input").value = JSON.stringify(guidance ?? JSON.parse(EXAMPLE), null, 1);
    at("structure").open = true;
    at("orders-input").focus();
  }

  #submit(event, body, cleared) {
    event.preventDefault();
    let made;
    try {
      made = body();
    } catch (error) {
      say(at("operator-error"), `These orders are no JSON: ${error.message}`);
      return;
    }
    this.#send(made).then((done) => {
      if (done && cleared) cleared.value = "";
    });
  }

  async #send(body) {
    if (this.busy || !this.mission) return false;
    this.busy = true;
    say(at("operator-error"), "");
    try {
      await post(`missions/${encodeURIComponent(this.mission.id)}/guidance`, body);
      return true;
    } catch (error) {
      say(at("operator-error"), error instanceof Refused ? `The edge refused: ${error.message}` : "The edge does not answer.");
      return false;
    } finally {
      this.busy = false;
    }
  }
}

function changes({ begins, ends }) {
  const parts = [ends.length && `These orders end when you confirm: ${ends.join(" ")}`, begins.length && `These begin: ${begins.join(" ")}`];
  return parts.filter(Boolean).join(" ") || "These orders are in force already.";
}

function summary(guidance, waits) {
  if (waits) return "orders wait for your confirmation";
  if (guidance.status === "compiling") return "the LLM is reading the note";
  if (guidance.obeyed_in_words) return guidance.obeyed_in_words;
  return guidance.status === "failed" ? "the note was not understood" : "no orders";
}
