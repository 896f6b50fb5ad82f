// A watched variable: its entries with names, units and ranges, to be read, set and plotted.

import { choice, element, isHeld, number } from "./common.js";
import { draggables } from "./pad.js";
import { Plot } from "./plot.js";
import { shownUnit } from "./search.js";

const ENTRIES = 12; // entries of an array that are shown

/**
 * A variable as the session describes it.
 *
 * `units` has the unit of each entry, where entries differ.
 *
 * @typedef {{ kind: string, shape: number[], unit: string, units: string[],
 *   bounds: [(number | null)[], (number | null)[]], settable: boolean, entries: string[],
 *   choices: { value: number, name: string }[] }} Variable
 */

/**
 * An entry of a variable, with its controls.
 *
 * @typedef {{ text: any, slider?: any, choice?: any, row: any, lower: number | null, upper: number | null,
 *   ranged: boolean }} Entry
 */

/**
 * @param {number | null | undefined} lower
 * @param {number | null | undefined} upper
 * @returns {string} the range as text; empty if there is no bound
 */
function rangeText(lower, upper) {
  const [least, most] = [lower, upper].map((bound) =>
    bound === null || bound === undefined ? "" : String(Number(bound.toPrecision(3))),
  );
  if (least && most) return least === `-${most}` ? `±${most}` : `${least} to ${most}`;
  if (least) return `from ${least}`;
  return most ? `to ${most}` : "";
}

export class Watched {
  /** @type {any[]} */
  values = [];
  draft = "none"; // "open" while a slider is dragged, "cancelled" until it is released
  typing = false;
  asked = 0; // the last command that set it
  /** @type {Plot | null} */
  plot = null;

  /**
   * @param {any} page
   * @param {string} address
   * @param {Variable} variable
   */
  constructor(page, address, variable) {
    this.page = page;
    this.address = address;
    this.variable = variable;
    const size = variable.shape.reduce((product, n) => product * n, 1);
    this.size = Math.min(size, ENTRIES);
    const units = variable.units.length ? variable.units : Array(size).fill(variable.unit);
    this.units = units.map(shownUnit);
    this.entries = Array.from({ length: this.size }, (_, index) => this.#entry(index));
    this.draggables = variable.choices.length ? [] : draggables(this);
    this.plotButton = element("button", {
      className: "plain",
      title: `plot ${address}`,
      "aria-pressed": "false",
      onclick: () => {
        this.togglePlot();
        this.plot?.root.scrollIntoView({ block: "nearest" });
      },
    });
    this.plotButton.textContent = "plot";
    this.pads = this.draggables.filter(({ root }) => !root.isConnected).map(({ root }) => root); // not in the scene
    for (const pad of this.pads) pad.hidden = true;
    this.root = element(
      "section",
      { className: "vtb-watched", "aria-label": address },
      element(
        "header",
        {},
        element("b", { title: address }, ...named(address)),
        variable.shape.length ? element("span", { className: "vtb-unit" }, this.#summary()) : "",
        ...this.pads.map((pad) => this.#padButton(pad)),
        this.plotButton,
        element(
          "button",
          { className: "plain", title: "remove", "aria-label": `remove ${address}`, onclick: () => page.unwatch(this) },
          "×",
        ),
      ),
      ...this.entries.map((entry) => entry.row),
      ...this.pads,
      size > ENTRIES ? element("small", {}, `and ${size - ENTRIES} more entries`) : "",
    );
    this.root.dataset.address = address;
  }

  /** @param {HTMLElement} pad */
  #padButton(pad) {
    const name = pad.classList.contains("dial") ? "dial" : "pad";
    const shows = element("button", {
      className: "plain",
      title: `${name} of ${this.address}`,
      "aria-pressed": "false",
    });
    shows.textContent = name;
    shows.onclick = () => {
      pad.hidden = !pad.hidden;
      shows.setAttribute("aria-pressed", String(!pad.hidden));
      pad.scrollIntoView({ block: "nearest" });
    };
    return shows;
  }

  // Unit and range, as far as they hold for all entries.
  #summary() {
    const units = new Set(this.units);
    const unit = units.size > 1 ? "" : this.units[0];
    const ranges = new Set(this.entries.map(({ lower, upper }) => rangeText(lower, upper)));
    this.hasOneRange = ranges.size === 1;
    const range = this.hasOneRange && !this.variable.choices.length ? [...ranges][0] : "";
    return [range, unit].filter(Boolean).join(" ");
  }

  /**
   * @param {number} index
   * @returns {string} the name of an entry: its own, or its indices
   */
  label(index) {
    const { shape, entries } = this.variable;
    if (!shape.length) return "";
    if (entries.length) return entries[index];
    return `[${shape.length === 2 ? `${Math.floor(index / shape[1])}, ${index % shape[1]}` : index}]`;
  }

  /**
   * @param {number} index
   * @returns {Entry}
   */
  #entry(index) {
    const { settable, bounds, choices } = this.variable;
    const [lower, upper] = bounds.map((side) => side[index]);
    const label = this.label(index);
    const name = label ? `${this.address} ${label}` : this.address;
    const unit = this.units[index];
    const title = [rangeText(lower, upper), unit].filter(Boolean).join(" ");
    const caption = label
      ? [element("span", { className: "vtb-label", title: label }, label, " ", element("small", {}, unit))]
      : [];
    const text = element("input", {
      type: "text",
      inputMode: "decimal",
      readOnly: !settable,
      title,
      "aria-label": unit ? `${name} in ${unit}` : name,
      onchange: () => {
        this.typing = false; // What was refused gives way to the present value.
        this.close("none"); // A drag that was cancelled before is over.
        this.commit({ [index]: text.value.trim() ? Number(text.value) : NaN });
      },
      onfocus: () => (this.typing = true),
      oninput: () => (this.typing = true),
      onblur: () => (this.typing = false),
    });
    const after = label || !title ? [] : [element("span", { className: "vtb-unit" }, title)];
    const entry = { text, lower, upper, ranged: false };
    const row = (/** @type {any[]} */ ...controls) =>
      element("div", { className: "vtb-entry" }, ...caption, ...controls);
    if (choices.length) {
      const made = choice(
        { "aria-label": name, disabled: !settable },
        (value) => this.commit({ [index]: Number(value) }),
        ...choices.map((option) => element("option", { value: String(option.value) }, option.name)),
      );
      return { ...entry, choice: made, row: row(made) };
    }
    if (!settable) return { ...entry, row: row(text, ...after) };
    const begin = () => (this.draft = "none");
    const slider = element("input", {
      type: "range",
      step: "any",
      title,
      "aria-label": name,
      disabled: true, // until its range is known, with the first value
      onpointerdown: begin,
      onkeydown: begin,
      onpointerup: () => setTimeout(() => this.#drop()), // behind the change that it makes
      oninput: () => this.preview({ [index]: Number(slider.value) }),
      onchange: () => this.commit({ [index]: Number(slider.value) }),
    });
    return { ...entry, slider, row: row(slider, text, ...after) };
  }

  /**
   * Only what is changed is sent: the other entries may have changed since, or may not be known yet.
   *
   * @param {Record<number, number>} changes entries by index
   * @returns {Record<string, number>} the same by address
   */
  #addressed(changes) {
    const { shape } = this.variable;
    return Object.fromEntries(
      Object.entries(changes).map(([index, value]) => [
        shape.length ? `${this.address}[${index}]` : this.address,
        value,
      ]),
    );
  }

  /** @param {Record<number, number>} changes */
  #changed(changes) {
    return this.values.map((old, index) => changes[index] ?? old);
  }

  /**
   * A drag is a draft: a fork of now runs ahead with it.
   *
   * @param {Record<number, number>} changes
   */
  preview(changes) {
    if (this.draft === "cancelled") return;
    this.draft = "open";
    for (const [index, value] of Object.entries(changes)) {
      const entry = this.entries[Number(index)];
      entry.row.classList.add("draft");
      entry.text.value = number(value);
      entry.slider.value = value;
    }
    for (const part of this.draggables) part.show(this.#changed(changes));
    this.page.preview(this, this.#addressed(changes));
  }

  /**
   * The release commits, unless the draft was cancelled.
   *
   * @param {Record<number, number>} changes
   */
  commit(changes) {
    const cancelled = this.draft === "cancelled";
    this.close("none");
    if (cancelled) return;
    if (!Object.values(changes).every(Number.isFinite)) return this.page.say(`${this.address} takes a number`, "bad");
    const before = Object.fromEntries(Object.keys(changes).map((index) => [index, this.values[Number(index)]]));
    const isKnown = Object.values(before).every(Number.isFinite);
    this.page.commit(this.#addressed(changes), isKnown ? this.#addressed(before) : null);
    this.asked = this.page.session.asked;
  }

  // A slider that is back where the drag began has no change.
  #drop() {
    if (this.draft !== "open") return;
    this.close("none");
    this.page.dropDraft();
  }

  /** @param {string} draft */
  close(draft) {
    this.draft = draft;
    for (const { row } of this.entries) row.classList.remove("draft");
  }

  /**
   * Shows a value. Where a state has none, as after a failure, the last one stays, marked.
   *
   * @param {number} time
   * @param {any} value
   */
  show(time, value) {
    const isKnown = value !== null;
    this.root.classList.toggle("vtb-stale", !isKnown);
    this.root.title = isKnown ? "" : "this state has no such value: the last one is shown";
    if (isKnown || !this.values.length) this.values = Array.isArray(value) ? value : [value];
    const isNew = this.draft !== "open" && this.page.reflects(this.asked);
    if (isNew) for (const [index, entry] of this.entries.entries()) this.#showEntry(entry, this.values[index]);
    if (isNew) for (const part of this.draggables) part.show(this.values);
    if (isKnown) this.plot?.extend(time, this.values);
  }

  /**
   * @param {Entry} entry
   * @param {any} now
   */
  #showEntry(entry, now) {
    if (this.typing) return;
    entry.text.value = typeof now === "string" ? now : number(now);
    if (entry.choice && !isHeld(entry.choice)) entry.choice.value = String(now);
    const { slider } = entry;
    if (!slider) return;
    if (!entry.ranged || now < Number(slider.min) || now > Number(slider.max)) {
      const reach = Math.max(2 * Math.abs(now), 1);
      slider.min = entry.lower ?? now - reach;
      slider.max = entry.upper ?? now + reach;
      slider.disabled = false;
      entry.ranged = true;
    }
    slider.value = now;
  }

  togglePlot() {
    const plots = !this.plot;
    this.plot?.destroy();
    this.plot = null;
    this.plotButton.setAttribute("aria-pressed", String(plots));
    if (plots) {
      const names = this.entries.map((_, index) => this.label(index) || this.address.split(".").slice(-2).join("."));
      this.plot = new Plot(this.address, this.units, names);
      this.root.append(this.plot.root);
      this.plot.begin();
    }
    this.page.keepLayout();
  }

  remove() {
    this.plot?.destroy();
    for (const part of this.draggables) part.remove();
    this.root.remove();
  }
}

/**
 * @param {string} address
 * @returns {any[]} the address with its beginning, which many have, in a soft colour; it may break behind its dots
 */
function named(address) {
  const parts = address.split(/(?<=\.)/);
  const end = parts.slice(-2).flatMap((part) => [element("wbr"), part]);
  return [element("i", {}, ...parts.slice(0, -2).flatMap((part) => [part, element("wbr")])), ...end];
}
