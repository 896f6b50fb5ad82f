// The switches T_sense and T_act of all signals, and the mode that they make.

import { choice, element, isHeld } from "./common.js";

// Positions of T_sense and T_act -> mode.
/** @type {Record<string, string>} */
const MODES = { "sim,sim": "sim", "real,sim": "shadow", "real,real": "real", "real,twin": "twin", "real,idle": "idle" };

export class Switches {
  /** @param {any} page */
  constructor(page) {
    this.page = page;
    this.asked = 0; // the last command that threw one
    this.list = element("div", { id: "vtb-switches" });
    this.mode = element("output", { id: "vtb-mode", title: "mode of the switches" });
    this.root = element("div", {}, element("h2", {}, "Switches"), this.list);
  }

  /** @param {object} _message says nothing about them: they come with the frames */
  hello(_message) {}

  /** @param {{ positions: Record<string, Record<string, string>> }} frame */
  frame({ positions }) {
    const sides = Object.entries(positions);
    for (const [side, signals] of sides) {
      if (Object.keys(signals).length > 1) this.#show(`vtb-${side}`, side, null, Object.values(signals));
      for (const [signal, position] of Object.entries(signals))
        this.#show(`vtb-${side}-${signal}`, side, signal, [position]);
    }
    this.root.hidden = !sides.some(([, signals]) => Object.keys(signals).length);
    const [senses, acts] = ["sense", "act"].map((side) => [...new Set(Object.values(positions[side] ?? {}))]);
    const mode =
      senses.length > 1 || acts.length > 1 ? "mixed" : MODES[`${senses[0] ?? "sim"},${acts[0] ?? senses[0] ?? "sim"}`];
    this.mode.textContent = sides.length ? (mode ?? "mixed") : "unknown";
    this.mode.dataset.mode = this.mode.textContent;
  }

  /**
   * Shows the switch of a signal, or of all signals of a side.
   *
   * @param {string} id
   * @param {string} side "sense" or "act"
   * @param {string | null} signal null for all of the side
   * @param {string[]} positions of the signals
   */
  #show(id, side, signal, positions) {
    const chosen = /** @type {HTMLSelectElement | null} */ (document.getElementById(id)) ?? this.#add(id, side, signal);
    if (isHeld(chosen) || !this.page.reflects(this.asked)) return;
    const position = new Set(positions).size > 1 ? "mixed" : positions[0];
    let option = [...chosen.options].find(({ value }) => value === position);
    if (!option) chosen.append((option = element("option", { hidden: true }, position)));
    /** @type {HTMLOptionElement} */ (option).selected = true;
    chosen.disabled = !this.page.can("switch");
    if (chosen.disabled) chosen.title = "a running loop alone throws its switches";
  }

  /**
   * @param {string} id
   * @param {string} side
   * @param {string | null} signal
   * @returns {HTMLSelectElement}
   */
  #add(id, side, signal) {
    const places = side === "sense" ? ["sim", "real"] : ["sim", "real", "twin"];
    const reason = element("small", { className: "bad" });
    const chosen = choice(
      { id },
      (position) => this.#throw(position, reason, side, signal),
      ...places.map((place) => element("option", {}, place)),
    );
    const label = element("label", { htmlFor: id }, signal ? `T_${side}.${signal}` : `T_${side}, all signals`);
    this.list.append(element("div", { className: "vtb-switch" }, label, chosen, reason));
    return chosen;
  }

  /**
   * @param {string} position
   * @param {HTMLElement} reason where a refusal is told
   * @param {string} side
   * @param {string | null} signal
   */
  #throw(position, reason, side, signal) {
    this.page.session.ask("switch", { [side]: signal ? { [signal]: position } : position }).then(
      () => (reason.textContent = ""),
      (/** @type {Error} */ error) => (reason.textContent = error.message),
    );
    this.asked = this.page.session.asked;
  }
}
