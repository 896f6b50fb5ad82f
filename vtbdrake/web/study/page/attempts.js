// Points that are tried: a point under sliders, which is simulated here or given to the study.

import { button, element, number } from "./common.js";

export class Attempts {
  /** @type {number[]} */
  draft = []; // the point under the sliders; of a choice it has the number of the option
  followsBest = true; // until somebody has moved the draft
  /** @type {any} */
  tried = null; // the last point that was tried, with its values
  #count = 0;

  /** @param {any} page of the study */
  constructor(page) {
    this.page = page;
    /** @type {any[]} */
    const parameters = page.parameters;
    this.draft = parameters.map((_, k) => page.scale(k).value(0.5));
    this.inputs = parameters.map((parameter, k) => this.#input(parameter, k));
    this.result = element("output", { id: "vtb-tried" });
    this.byClick = element("input", { type: "checkbox", id: "vtb-try-click" });
    const { simulates, obstacle } = page.hello;
    const attempt = button("vtb-attempt", "try it here", "simulate it now, under all conditions", () => this.attempt());
    page.allow(attempt, simulates ? "" : `points cannot be simulated here: ${obstacle}`);
    const title = "it is evaluated with the next batch, and the solver learns from it";
    this.section = element(
      "section",
      { id: "vtb-try" },
      ...this.inputs.map(({ row }) => row),
      element(
        "div",
        { className: "vtb-row" },
        attempt,
        button("vtb-add", "give it to the study", title, () => this.#give()),
        element("label", {}, this.byClick, " a click into the landscape tries"),
      ),
      this.result,
    );
    for (const { update } of this.inputs) update();
  }

  get tryByClick() {
    return this.byClick.checked && !this.section.hidden;
  }

  /**
   * @param {any} parameter
   * @param {number} k its number
   * @returns {{ update: () => void, row: HTMLElement }} its slider and its text
   */
  #input(parameter, k) {
    const { address, unit, integer, options } = parameter;
    const last = options ? Math.max(1, options.length - 1) : 1;
    const replaced = (/** @type {number} */ value) =>
      this.setDraft(this.draft.map((before, i) => (i === k ? value : before)));
    const show = () => (text.value = options ? options[this.draft[k]] : number(this.draft[k]));
    const scale = this.page.scale(k);
    const slider = element("input", {
      type: "range",
      min: 0,
      max: 1,
      step: options ? 1 / last : "any",
      "aria-label": address,
      oninput: () => {
        const at = Number(slider.value);
        const value = options ? Math.round(at * (options.length - 1)) : scale.value(at);
        replaced(integer ? Math.round(value) : value);
      },
      onchange: () => this.attempt(),
    });
    const text = element("input", {
      type: "text",
      readOnly: Boolean(options),
      "aria-label": address,
      onchange: () => {
        if (text.value.trim() !== "" && Number.isFinite(Number(text.value))) replaced(Number(text.value));
        show();
      },
    });
    const update = () => {
      slider.value = options ? this.draft[k] / last : scale.unit(this.draft[k]);
      if (document.activeElement !== text) show(); // A better trial does not take away what is being typed.
    };
    const label = `${this.page.parameterLabel(k)} ${unit === "1" || !unit ? "" : `[${unit}]`}`;
    const row = element("div", { className: "vtb-entry" }, element("label", { title: address }, label), slider, text);
    return { update, row };
  }

  /** @param {number[]} point */
  setDraft(point, { followsBest = false } = {}) {
    this.draft = point.map((value, k) => {
      const { lower, upper, integer, options } = this.page.parameters[k];
      if (options) return value;
      const inside = Math.min(Math.max(value, lower), upper);
      return integer ? Math.round(inside) : inside;
    });
    this.followsBest = followsBest;
    for (const { update } of this.inputs) update();
    this.page.draw();
  }

  async attempt() {
    const { page } = this;
    if (!page.hello.simulates) return;
    this.result.textContent = "simulating…";
    this.#count += 1;
    const attempt = this.#count;
    try {
      const tried = await page.ask("try", { point: this.draft, condition: page.rollouts.condition });
      if (attempt !== this.#count) return;
      this.#show(tried);
      document.body.dataset.tried = String(attempt);
    } catch (error) {
      this.result.textContent = /** @type {Error} */ (error).message;
      this.result.className = "bad";
    }
  }

  /** @param {any} tried the point with its values */
  #show(tried) {
    const { page } = this;
    const { best, values: columns } = page.trials;
    this.tried = tried;
    const values = tried.values
      .map((/** @type {any} */ value, /** @type {number} */ q) => page.valued(q, value))
      .join(", ");
    const record = best >= 0 && page.qualities.length === 1 ? ` (best: ${number(columns[0][best])})` : "";
    /** @type {Record<string, string>} */
    const remarks = { failed: `failed: ${tried.message}`, broken: "breaks a constraint", feasible: "" };
    this.result.textContent = [values + record, remarks[tried.kind]].filter(Boolean).join("; ");
    this.result.className = tried.kind === "feasible" ? "" : "bad";
    page.playback.legend("tried", true);
    page.playback.extend(tried.duration);
    page.draw();
  }

  async #give() {
    const { page } = this;
    if ((await page.do("give", { point: this.draft })) === undefined) return;
    const running = page.isRunning;
    page.say(running ? "the study evaluates it with its next batch" : "it waits until the study goes on");
  }
}
